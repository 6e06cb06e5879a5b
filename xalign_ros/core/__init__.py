"""The algorithm: keyframe in, correction out. Imports no ROS, reads no file and no clock, starts no thread."""
