"""Geographic positions in the local axes east, north, up of an origin (REP-103), on the WGS84 ellipsoid."""

from __future__ import annotations

import numpy as np

from xalign_ros.core.lie import Array

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563


def enu_from_geodetic(position: Array, origin: Array) -> Array:
    """East, north, up (N, 3) m, seen from origin (3,), of positions (N, 3): latitude, longitude (deg), height (m).

    Heights are above the ellipsoid. By way of earth-centred coordinates: Hofmann-Wellenhof et al., GNSS (2008), 8.2.
    """
    latitude, longitude = np.deg2rad(np.asarray(origin, float)[:2])
    (a, b), (c, d) = (np.sin([latitude, longitude]), np.cos([latitude, longitude]))
    R_enu_ecef = np.array([[-b, d, 0], [-a * d, -a * b, c], [c * d, c * b, a]])
    return np.asarray((_ecef(np.asarray(position, float)) - _ecef(np.asarray(origin, float)[None])) @ R_enu_ecef.T)


def _ecef(position: Array) -> Array:
    latitude, longitude = np.deg2rad(position[:, :2]).T
    eccentricity2 = FLATTENING * (2 - FLATTENING)
    N = SEMI_MAJOR_M / np.sqrt(1 - eccentricity2 * np.sin(latitude) ** 2)
    out = (N + position[:, 2]) * np.cos(latitude)
    up = (N * (1 - eccentricity2) + position[:, 2]) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], axis=1)
