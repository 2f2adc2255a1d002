"""One module per command: its arguments, and `run(command, console)`, which gives the exit status.

Every command imports what it needs when it runs, so that `--help` is immediate.
"""
