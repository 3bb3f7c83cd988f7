"""setuptools, told what a wheel needs at build time: the estimator is compiled where it is built (`setup.py`).

An editable installation and a source distribution need none of it.
"""

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403


def get_requires_for_build_wheel(config_settings=None):
    """Return what has to be installed before a wheel is built (PEP 517)."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), "numba>=0.58", "numpy>=1.26", "scipy>=1.11"]
