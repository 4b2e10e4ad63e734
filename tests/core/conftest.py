"""Settings of property tests: deterministic, without a deadline, since the machine may be busy."""

from hypothesis import settings

settings.register_profile("core", deadline=None, derandomize=True)
settings.load_profile("core")
