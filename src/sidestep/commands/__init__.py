"""One module per command: its options, and `run(command, console)`, which returns the exit status.

A command imports what it needs when it runs, so that `--help` is fast.
"""
