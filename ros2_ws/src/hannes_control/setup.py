"""Everything is declared in setup.cfg; colcon needs this file to find it."""

from setuptools import setup

setup()
