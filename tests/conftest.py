import signal

from hypothesis import settings

# Timings of shared machines say nothing; with the same examples everywhere anybody can repeat a failure.
settings.register_profile("pantograph", deadline=None, derandomize=True)
settings.load_profile("pantograph")

# A shell that runs the tests in the background has them ignore Ctrl-C, and what they start with them.
signal.signal(signal.SIGINT, signal.default_int_handler)
