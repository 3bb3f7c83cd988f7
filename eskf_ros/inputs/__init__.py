"""Ranges out of RINEX files beside a recording: merged while it is read, or written into a copy of it."""
