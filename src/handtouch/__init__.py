"""handtouch: middleware that gives a robot hand a sense of touch."""

__version__ = "0.1.0"
