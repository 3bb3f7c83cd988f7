"""`eskf_watch`: the diagnostics of a running node, or of a recording, as a dashboard in the terminal."""
