# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core import earth

LATITUDE = st.floats(-math.pi / 2, math.pi / 2)
LONGITUDE = st.floats(-math.pi, math.pi)
A, B = earth.SEMI_MAJOR_AXIS, earth.SEMI_MINOR_AXIS
few = settings(max_examples=60, deadline=None)


def up(latitude, longitude):
    cosine = math.cos(latitude)
    return np.array([cosine * math.cos(longitude), cosine * math.sin(longitude), math.sin(latitude)])


def test_derived_constants_are_the_published_ones():
    assert pytest.approx(6356752.3142, abs=1e-4) == B
    assert pytest.approx(6.694379990141e-3, rel=1e-12) == earth.ECCENTRICITY_SQUARED
    assert pytest.approx(1.931852652458e-3, rel=2e-8) == earth.SOMIGLIANA
    assert pytest.approx(3.449786506841e-3, rel=1e-10) == earth.GRAVITY_RATIO


@few
@given(latitude=LATITUDE, longitude=LONGITUDE)
def test_a_point_of_height_zero_lies_on_the_ellipsoid_and_its_normal_is_up(latitude, longitude):
    x, y, z = earth.ecef_from_geodetic(latitude, longitude, 0.0)
    assert (x * x + y * y) / A**2 + z * z / B**2 == pytest.approx(1.0, abs=1e-14)
    normal = np.array([x / A**2, y / A**2, z / B**2])
    assert np.allclose(normal / np.linalg.norm(normal), up(latitude, longitude), atol=1e-14)


@few
@given(latitude=LATITUDE, longitude=LONGITUDE, height=st.floats(-1e4, 4e7))
def test_height_is_measured_along_the_normal(latitude, longitude, height):
    foot = earth.ecef_from_geodetic(latitude, longitude, 0.0)
    expected = foot + height * up(latitude, longitude)
    assert np.allclose(earth.ecef_from_geodetic(latitude, longitude, height), expected, atol=2e-8, rtol=0)


@few
@given(latitude=LATITUDE, longitude=LONGITUDE, height=st.floats(-5e6, 5e7))
def test_geodetic_positions_come_back_to_a_nanometre(latitude, longitude, height):
    position = earth.ecef_from_geodetic(latitude, longitude, height)
    back = earth.geodetic_from_ecef(position)
    # Rounding of the position itself is 7e-9 m at 5e7 m.
    tolerance = 1e-9 + 4e-16 * np.linalg.norm(position)
    assert abs(back[2] - height) < tolerance
    assert np.linalg.norm(earth.ecef_from_geodetic(*back) - position) < 3.0 * tolerance


@pytest.mark.parametrize('height', [-5e6, -500.0, 0.0, 1e6])
def test_the_poles_and_the_equator_are_ordinary_points(height):
    assert earth.geodetic_from_ecef(np.array([0.0, 0.0, B + height])) == pytest.approx(
        (math.pi / 2, 0.0, height), abs=1e-8
    )
    assert earth.geodetic_from_ecef(np.array([0.0, 0.0, -B - height])) == pytest.approx(
        (-math.pi / 2, 0.0, height), abs=1e-8
    )
    assert earth.geodetic_from_ecef(np.array([0.0, -A - height, 0.0])) == pytest.approx(
        (0.0, -math.pi / 2, height), abs=1e-8
    )


def test_the_centre_of_the_earth_gives_finite_numbers():
    assert all(math.isfinite(value) for value in earth.geodetic_from_ecef(np.zeros(3)))


def test_series_are_the_single_conversions_in_rows():
    rng = np.random.default_rng(1)
    geodetic = np.column_stack([rng.uniform(-1.5, 1.5, 20), rng.uniform(-3, 3, 20), rng.uniform(0, 1e4, 20)])
    positions = earth.ecef_from_geodetic_series(geodetic)
    for row, position in zip(geodetic, positions):
        assert np.array_equal(position, earth.ecef_from_geodetic(*row))
        assert np.array_equal(
            earth.geodetic_from_ecef_series(position[np.newaxis])[0], earth.geodetic_from_ecef(position)
        )
    assert np.allclose(earth.geodetic_from_ecef_series(positions), geodetic, atol=1e-8, rtol=0)


@pytest.mark.parametrize('latitude', [-1.2, 0.0, 0.7, 1.5])
def test_the_radii_are_the_derivatives_of_the_position(latitude):
    step = 1e-4
    meridian, normal = earth.radii(latitude)
    for height in (0.0, 5000.0):
        north = earth.ecef_from_geodetic(latitude + step, 0.3, height) - earth.ecef_from_geodetic(
            latitude - step, 0.3, height
        )
        east = earth.ecef_from_geodetic(latitude, 0.3 + step, height) - earth.ecef_from_geodetic(
            latitude, 0.3 - step, height
        )
        assert np.linalg.norm(north) / (2 * step) == pytest.approx(meridian + height, rel=1e-7)
        assert np.linalg.norm(east) / (2 * step) == pytest.approx(
            (normal + height) * math.cos(latitude), rel=1e-7
        )


@few
@given(latitude=st.floats(-1.5, 1.5), longitude=LONGITUDE)
def test_local_axes_point_north_east_and_along_the_normal(latitude, longitude):
    step = 1e-5
    here = earth.ecef_from_geodetic(latitude, longitude, 0.0)
    north = earth.ecef_from_geodetic(latitude + step, longitude, 0.0) - here
    east = earth.ecef_from_geodetic(latitude, longitude + step, 0.0) - here
    ned = earth.mat_ecef_from_ned(latitude, longitude)
    enu = earth.mat_ecef_from_enu(latitude, longitude)
    assert np.allclose(ned[:, 0], north / np.linalg.norm(north), atol=2e-5)
    assert np.allclose(ned[:, 1], east / np.linalg.norm(east), atol=2e-5)
    assert np.allclose(ned[:, 2], -up(latitude, longitude), atol=1e-15)
    for mat in (ned, enu):
        assert np.allclose(mat.T @ mat, np.eye(3), atol=1e-15)
        assert np.linalg.det(mat) == pytest.approx(1.0)
    vec = np.array([1.0, -2.0, 3.0])
    assert np.allclose(enu @ earth.swap_ned_enu(vec), ned @ vec, atol=1e-14)
    assert np.array_equal(earth.swap_ned_enu(earth.swap_ned_enu(vec)), vec)


@few
@given(latitude=LATITUDE, longitude=LONGITUDE, seed=st.integers(0, 2**32 - 1))
def test_local_positions_come_back_and_keep_distances(latitude, longitude, seed):
    origin = (latitude, longitude, 120.0)
    enu = np.random.default_rng(seed).uniform(-1e4, 1e4, 3)
    position = earth.ecef_from_enu(enu, *origin)
    assert np.allclose(earth.enu_from_ecef(position, *origin), enu, atol=1e-8)
    assert np.linalg.norm(position - earth.ecef_from_geodetic(*origin)) == pytest.approx(np.linalg.norm(enu))
    above = earth.geodetic_from_ecef(earth.ecef_from_enu(np.array([0.0, 0.0, 50.0]), *origin))
    assert above[2] == pytest.approx(170.0, abs=1e-7)


@pytest.mark.parametrize(
    ('latitude', 'published'),
    [(0.0, 9.7803253359), (math.pi / 2, 9.8321849378), (math.pi / 4, 9.8061977693)],
)
def test_gravity_on_the_ellipsoid_is_the_published(latitude, published):
    assert earth.gravity(latitude, 0.0) == pytest.approx(published, abs=2e-10)
    assert earth.gravity(-latitude, 0.0) == earth.gravity(latitude, 0.0)


def exact_normal_gravity(latitude, height):
    """Gradient of the level ellipsoid's potential in closed form: Heiskanen and Moritz (1967), 2-62."""
    E = math.sqrt(A * A - B * B)
    omega2, gm = earth.EARTH_RATE**2, earth.GRAVITATIONAL_PARAMETER
    q0 = 0.5 * ((1 + 3 * B * B / E**2) * math.atan(E / B) - 3 * B / E)

    def potential(p, z):
        s = p * p + z * z - E * E
        u = math.sqrt(0.5 * (s + math.sqrt(s * s + 4 * E * E * z * z)))
        sine2 = (z / u) ** 2
        q = 0.5 * ((1 + 3 * u * u / E**2) * math.atan(E / u) - 3 * u / E)
        return gm / E * math.atan(E / u) + 0.5 * omega2 * (A * A * q / q0 * (sine2 - 1 / 3) + p * p)

    x, _, z = earth.ecef_from_geodetic(latitude, 0.0, height)
    step = 200.0  # m: five-point differences, whose rounding and truncation are both below 1e-8 m/s²

    def slope(f):
        return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)

    return math.hypot(slope(lambda d: potential(x + d, z)), slope(lambda d: potential(x, z + d)))


@pytest.mark.parametrize('latitude', [0.0, 0.4, 0.9, 1.4])
@pytest.mark.parametrize(('height', 'tolerance'), [(0.0, 5e-8), (1000.0, 2e-7), (1e4, 1e-6), (1e5, 2e-4)])
def test_gravity_follows_the_exact_field_of_the_level_ellipsoid(latitude, height, tolerance):
    assert earth.gravity(latitude, height) == pytest.approx(
        exact_normal_gravity(latitude, height), abs=tolerance
    )


def test_the_formula_of_the_papers_agrees_with_the_closed_form_when_its_first_constant_is_right():
    for latitude in (0.0, 0.5, 1.0, 1.5):
        for height in (0.0, 3000.0):
            difference = earth.gravity_series_formula(latitude, height) - earth.gravity(latitude, height)
            # GRS-80 against WGS-84 is 1.4e-6 m/s² everywhere, less what the series leaves out.
            assert 0.0 < difference < 1.6e-6
    assert earth.gravity_series_formula(0.0, 0.0) == 9.7803267715


@pytest.mark.parametrize('latitude', [-1.0, 0.0, 0.6])
def test_the_earths_rotation_is_the_ecef_axis_seen_locally(latitude):
    expected = earth.mat_ecef_from_ned(latitude, 0.8).T @ [0.0, 0.0, earth.EARTH_RATE]
    assert np.allclose(earth.earth_rate_ned(latitude), expected, atol=1e-20)


@pytest.mark.parametrize('latitude', [-1.0, 0.0, 0.6])
def test_the_transport_rate_is_the_turning_of_the_local_axes_on_the_way(latitude):
    velocity, height, dt = np.array([120.0, -70.0, 5.0]), 2000.0, 1e-2
    meridian, normal = earth.radii(latitude)
    ahead = earth.mat_ecef_from_ned(
        latitude + velocity[0] / (meridian + height) * dt,
        0.3 + velocity[1] / ((normal + height) * math.cos(latitude)) * dt,
    )
    turned = earth.mat_ecef_from_ned(latitude, 0.3).T @ ahead
    rate = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    assert np.allclose(
        earth.transport_rate_ned(latitude, height, velocity), rate / (2 * dt), rtol=1e-5, atol=1e-11
    )
