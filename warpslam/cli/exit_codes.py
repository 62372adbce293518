"""What the command returns to the shell.

0 is success, and so is a run that was already finished. 1 is success with something to look at: `check` found an error,
`batch` has sequences that are not done, `bench` a run that failed. The others:
"""

EXIT_ERROR = 2
"""Something that the user can put right stopped it: an option, the input, a missing package, a full disk."""
EXIT_UNEXPECTED = 70
"""An error that is none of ours to expect."""
EXIT_INTERRUPTED = 130
"""Ctrl-C; what there was by then is written."""
EXIT_TERMINATED = 143
"""SIGTERM; what there was by then is written."""
