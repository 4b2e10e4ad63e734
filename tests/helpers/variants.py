"""The Mitsuba variant that tests compute in: the environment variable MI_NTF_TEST_VARIANT, ``llvm_ad_rgb`` unless
told. ``MI_NTF_TEST_VARIANT=cuda_ad_rgb make test`` runs the same tests on a GPU."""

import os

VARIANT = os.environ.get("MI_NTF_TEST_VARIANT", "llvm_ad_rgb")
