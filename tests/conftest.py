"""What all tests take for granted of their process."""

import signal

# A shell starts background jobs with Ctrl-C ignored, and their children inherit that. Tests that
# press it mean it to work, here and in the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
