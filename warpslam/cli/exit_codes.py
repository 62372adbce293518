"""What the command returns to the shell, besides 0 and what single commands add."""

EXIT_ERROR = 2
"""Something that the user can put right stopped it."""
EXIT_INTERRUPTED = 130
"""Ctrl-C."""
EXIT_TERMINATED = 143
"""SIGTERM."""
EXIT_UNEXPECTED = 70
"""An error that is none of ours to expect."""
