"""xalign: keyframe in, correction out."""

__version__ = "0.1.0"
