"""touchgoal: turn touch into a goal. See README.md."""

__version__ = "0.1.0"
