"""The last step of what is published, off unless asked for: a correction that eases over instead of jumping."""

from __future__ import annotations

from xalign_ros.core.transforms import SE3, Sim3


def eased(before: Sim3, now: Sim3, T_odom_cam: SE3, share: float) -> Sim3:
    """S_map_odom `share` of the way from the last published to the new one, along the geodesic at the camera.

    At the camera, so that the published pose moves by that share of its jump whatever the lever arm to the odometry's
    origin.
    """
    last, new = before @ T_odom_cam, now @ T_odom_cam
    return last @ Sim3.exp(share * (last.inverse() @ new).log()) @ T_odom_cam.inverse()
