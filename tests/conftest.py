from hypothesis import settings

# Timings of shared machines say nothing; with the same examples everywhere anybody can repeat a failure.
settings.register_profile("pantograph", deadline=None, derandomize=True)
settings.load_profile("pantograph")
