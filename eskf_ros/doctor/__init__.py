"""The bag doctor, `eskf_check`: what is wrong or odd with a recording, before one runs it."""
