"""For all tests: machines are shared and noisy, so no example of a property has a deadline; pytest's time-out holds."""

from hypothesis import settings

settings.register_profile("overfly", deadline=None)
settings.load_profile("overfly")
