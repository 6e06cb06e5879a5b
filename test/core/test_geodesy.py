"""East, north, up: what is known of the ellipsoid, and that it is a rigid frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core.geodesy import FLATTENING, SEMI_MAJOR_M, enu_from_geodetic

E2 = FLATTENING * (2 - FLATTENING)
places = st.tuples(st.floats(-89, 89), st.floats(-180, 180), st.floats(-400, 9000)).map(np.array)


@given(places)
def test_a_step_goes_by_the_radii_of_curvature(origin) -> None:
    """Meridian and prime vertical (Torge and Mueller, Geodesy, 2012, section 4.1.3)."""
    latitude, step = np.deg2rad(origin[0]), 1e-5
    w = np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    meridian, vertical = SEMI_MAJOR_M * (1 - E2) / w**3, SEMI_MAJOR_M / w
    north, east, up = enu_from_geodetic(origin + np.diag([step, step, 1.0]), origin)
    assert north == pytest.approx([0, np.deg2rad(step) * (meridian + origin[2]), 0], abs=1e-5)
    assert east == pytest.approx([np.deg2rad(step) * (vertical + origin[2]) * np.cos(latitude), 0, 0], abs=1e-5)
    assert up == pytest.approx([0, 0, 1], abs=1e-8)


@given(places, places)
def test_distances_are_the_same_from_any_origin(a, b) -> None:
    points = np.stack([a, a + np.array([0.01, -0.02, 30]), b])
    gaps = [np.linalg.norm(np.diff(enu_from_geodetic(points, origin), axis=0), axis=1) for origin in (a, b)]
    np.testing.assert_allclose(*gaps, rtol=1e-9, atol=1e-6)


def test_the_poles_are_where_they_are() -> None:
    """Seen from latitude 0, longitude 0: north by the semi-minor axis, below by the semi-major one."""
    pole = enu_from_geodetic(np.array([[90.0, 12.0, 0.0]]), np.zeros(3))[0]
    np.testing.assert_allclose(pole, [0, SEMI_MAJOR_M * (1 - FLATTENING), -SEMI_MAJOR_M], atol=1e-6)
