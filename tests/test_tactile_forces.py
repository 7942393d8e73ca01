"""Force field, stick and slip, markers: integrals against the solver, laws of contact mechanics."""

from dataclasses import replace

import numpy as np
import pytest

from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS as MINI
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.tactile.forces import ForceField, force_field
from touchgoal.sim_envs.tactile.geometry import NO_SURFACE, Grid
from touchgoal.sim_envs.tactile.markers import GelMotion, layer_compliance
from touchgoal.sim_envs.tactile.press import press_until_balanced

GRID = Grid(88, 108, 4 * MINI.pixel_pitch)
Y, X = (
    ((np.arange(n) - (n - 1) / 2) * GRID.pitch).reshape(shape)
    for n, shape in ((GRID.rows, (-1, 1)), (GRID.columns, (1, -1)))
)
FRICTION = 0.6
INCIPIENT, GROSS = 0.25, 0.98  # shares of the load on slipping cells


def slipping(field: ForceField, friction: float = FRICTION) -> np.ndarray:
    """Cells whose traction lies on the friction cone."""
    traction = np.linalg.norm(field.tangential, axis=0)
    return (field.normal > 0) & (traction >= 0.99 * friction * field.normal)


def slip_fraction(field: ForceField, friction: float = FRICTION) -> float:
    """Share of the normal force that slipping cells carry."""
    return float(field.normal[slipping(field, friction)].sum() / field.normal.sum())


def ball(x: float = 0.0, y: float = 0.0, radius: float = 0.02) -> np.ndarray:
    """Height field of a ball that just touches the gel."""
    below = radius**2 - (X - x) ** 2 - (Y - y) ** 2
    height = np.sqrt(np.maximum(below, 0)) - radius
    return np.where(below > 0, height, NO_SURFACE).astype(np.float32)


def block(left: float, right: float, top: float, bottom: float) -> np.ndarray:
    inside = (left < X) & (X < right) & (top < Y) & (Y < bottom)
    return np.where(inside, np.float32(0), NO_SURFACE)


EVERYWHERE = block(-1, 1, -1, 1)


def wrench(
    normal: float, at: tuple = (0.0, 0.0), shear: tuple = (0.0, 0.0), torsion: float = 0.0
) -> PadContact:
    """Return the contact of a force at one point of the sunk gel, and a torsion about the point."""
    force = np.array([*shear, -normal])
    point = np.array([*at, -normal / MINI.normal_stiffness])
    torque = np.cross(point, force) + [0, 0, torsion]
    return PadContact(force, torque, 0.0, frozenset({1}))


def feel(
    height: np.ndarray, *contacts: PadContact, friction: float = FRICTION, modulus: float = 3e8
) -> ForceField:
    """Return the force field after a history of contacts."""
    field = None
    for contact in contacts:
        press = press_until_balanced(height, GRID.pitch, contact, modulus, MINI)
        field = force_field(press, field, contact, friction, MINI)
    assert field is not None
    return field


@pytest.mark.parametrize(
    "height, contact",
    [
        (ball(2e-3, 1e-3), wrench(5.0, (2e-3, 1e-3), (1.5, -1.0), 2e-3)),
        (ball(2e-3, 1e-3), wrench(5.0, (2.3e-3, 0.8e-3), (1.5, -1.0), 2e-3)),
        (EVERYWHERE, wrench(30.0, (4e-3, -2e-3), (6.0, 2.0), 50e-3)),
        (EVERYWHERE, wrench(80.0)),
        (block(2e-3, 9e-3, -3e-3, 3e-3), wrench(3.0, (6e-3, 0.5e-3), (0.5, 0.2), 1e-3)),
        (np.maximum(ball(-6e-3), ball(6e-3) - 1e-4), wrench(4.0, (1e-3, 0.0), (0.3, 0.6), 3e-3)),
        (ball(radius=5e-3), wrench(1e-2, (0.0, 0.0), (4e-3, 0.0))),
    ],
    ids=["ball", "rolling", "larger than the gel", "hard", "off centre", "two patches", "tiny"],
)
def test_field_integrates_to_the_wrench(height: np.ndarray, contact: PadContact) -> None:
    field = feel(height, contact)
    force, torque = contact.force, contact.torque
    found = field.wrench()
    assert np.linalg.norm(found[:3] - force) < 0.001 * np.linalg.norm(force)
    # 1 % of the force's moment at 5 mm, half of a contact's usual width.
    assert np.linalg.norm(found[3:] - torque) < 0.01 * 5e-3 * np.linalg.norm(force)
    assert field.normal.min() >= 0
    beyond = np.linalg.norm(field.tangential, axis=0) - FRICTION * field.normal
    assert beyond.max() < 0.001 * FRICTION * field.normal.max()


def test_tilt_carries_a_moment_and_nothing_tilts_without() -> None:
    upright = press_until_balanced(EVERYWHERE, GRID.pitch, wrench(20.0), 3e8, MINI)
    tilted = press_until_balanced(EVERYWHERE, GRID.pitch, wrench(20.0, (2e-3, 0.0)), 3e8, MINI)
    assert upright.tilt == pytest.approx((0, 0), abs=1e-6)
    # Linear foundation of area A and second moment I: F / (k A), and F e / (k I + what holds it).
    width, height = GRID.columns * GRID.pitch, GRID.rows * GRID.pitch
    assert upright.shift == pytest.approx(20 / (3e8 * width * height), rel=1e-3)
    stiffness = 3e8 * width**3 * height / 12 + 1.0
    assert tilted.tilt == pytest.approx((20 * 2e-3 / stiffness, 0), rel=0.02, abs=1e-6)
    assert tilted.shift == pytest.approx(upright.shift, rel=1e-3)
    seated = EVERYWHERE.copy()
    tilted.push_in(seated, GRID.pitch)
    np.testing.assert_allclose(3e8 * seated, tilted.pressure, rtol=1e-4)


def test_stuck_object_stays_on_its_cells_when_the_gel_shears() -> None:
    shear = np.array([3.0, -2.0])
    x, y = shear / MINI.shear_stiffness  # half a millimetre, two cells of the height field
    before = feel(ball(), wrench(8.0))
    after = feel(ball(x, y), wrench(8.0, (x, y), tuple(shear)))
    difference = np.abs(after.normal - before.normal)
    assert difference.max() < 0.01 * before.normal.max()


@pytest.mark.parametrize("share", [0.3, 0.75, 0.95])
def test_slip_grows_from_the_rim_as_under_a_ball(share: float) -> None:
    """Parabolic pressure on bristles: F = mu N (2 m - m^2), and m^2 of the load slips."""
    pulls = [wrench(6.0, shear=(s * share * FRICTION * 6.0, 0)) for s in np.linspace(0, 1, 6)]
    field = feel(ball(), *pulls)
    slips = slip_fraction(field)
    assert slips == pytest.approx((1 - np.sqrt(1 - share)) ** 2, abs=0.04)
    stuck = (field.normal > 0) & ~slipping(field)
    assert field.normal[stuck].min() > 0.5 * np.median(field.normal[slipping(field)])
    assert (slips >= INCIPIENT) == (share > 0.73) and slips < GROSS


def test_gel_remembers_a_pull_until_contact_is_lost() -> None:
    still, pulled = wrench(6.0), wrench(6.0, shear=(0.0, 2.7))
    released = feel(ball(), still, pulled, still)
    assert np.abs(released.tangential).max() > 0.2 * FRICTION * released.normal.max()
    assert np.abs(released.wrench()[:2]).max() < 1e-3
    assert np.abs(feel(ball(), still).tangential).max() == 0
    lighter = feel(ball(), still, pulled, wrench(3.0))
    beyond = np.linalg.norm(lighter.tangential, axis=0) - FRICTION * lighter.normal
    assert beyond.max() < 1e-3 * lighter.normal.max()


def test_spin_turns_the_traction_about_the_contact() -> None:
    at = 3e-3, -2e-3
    field = feel(ball(*at), wrench(6.0, at, torsion=4e-3))
    x = X[0, ::2] + GRID.pitch / 2 - at[0]
    y = Y[::2] + GRID.pitch / 2 - at[1]
    turn = x * field.tangential[1] - y * field.tangential[0]
    assert turn[field.normal > 1e-3 * field.normal.max()].min() > -1e-9
    assert turn.sum() == pytest.approx(4e-3, rel=0.01)
    # More than 8/15 of mu N a, the patch's all: everything slips, and the sum is still right.
    spun = feel(ball(*at), wrench(6.0, at, torsion=20e-3))
    assert slip_fraction(spun) >= GROSS and spun.wrench()[5] == pytest.approx(20e-3, rel=0.01)


@pytest.mark.parametrize("k", [50.0, 250.0, 1500.0])
def test_layer_gives_way_as_the_equations_of_elasticity_say(k: float) -> None:
    """An incompressible layer, vertical motion f(z) exp(ikx), held at z = -t; f has 4 unknowns."""
    t, shear = MINI.gel_thickness, MINI.shear_modulus

    def f(z: float, n: int = 0) -> np.ndarray:
        up, down = np.exp(k * z), np.exp(-k * z)
        rising, falling = n * k ** max(n - 1, 0), n * (-k) ** max(n - 1, 0)
        growing = [k**n * up, (rising + k**n * z) * up]
        return np.array([*growing, (-k) ** n * down, (falling + (-k) ** n * z) * down])

    held, sideways = f(-t), f(-t, 1)
    traction = shear * (f(0, 2) / k + k * f(0))  # times i
    stress = shear * (3 * f(0, 1) - f(0, 3) / k**2)
    system = np.stack([held, sideways, traction, stress])
    pulled = np.linalg.solve(system, [0, 0, 1, 0])
    pressed = np.linalg.solve(system, [0, 0, 0, -1])
    along, across, squeeze = layer_compliance(MINI, np.array([k]))
    assert along[0] == pytest.approx(f(0, 1) @ pulled / k, rel=1e-6)
    assert squeeze[0] == pytest.approx(-(f(0, 1) @ pressed) / k**2, rel=1e-6)
    # Pulled along the wave it rises by f(0): what `ShearRelief` takes from `squeeze` by reciprocity.
    assert k * squeeze[0] == pytest.approx(abs(f(0) @ pulled), rel=1e-6)
    # Across the wave only shear acts: v'' = k^2 v, v(-t) = 0, G v'(0) = 1.
    assert across[0] == pytest.approx(np.sinh(k * t) / (shear * k * np.cosh(k * t)), rel=1e-6)


def cells() -> np.ndarray:
    """Centres of the force field's cells, m."""
    x, y = X[0, ::2] + GRID.pitch / 2, Y[::2, 0] + GRID.pitch / 2
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


@pytest.mark.parametrize(
    "height", [ball(radius=0.01), ball(radius=0.03), block(-1, 1, -2e-3, 2e-3), EVERYWHERE]
)
def test_markers_under_a_sliding_object_move_with_the_plate(height: np.ndarray) -> None:
    normal, at = 5.0, (1.5, 2.0)
    field = feel(height, wrench(normal), wrench(normal, shear=at), friction=0.5)
    assert slip_fraction(field, friction=0.5) >= GROSS
    pushed = GelMotion(MINI, GRID, cells())(replace(field, normal=1e-9 * field.normal))
    mean = field.normal.ravel() @ pushed / field.normal.sum()
    np.testing.assert_allclose(mean, np.array(at) / MINI.shear_stiffness, rtol=0.15)


def test_pressed_gel_spreads_outwards_and_little_under_the_object() -> None:
    field = feel(ball(), wrench(8.0))
    points = np.array([[r, 0.0] for r in (0.0, 2e-3, 6e-3, 10e-3)])
    x, y = GelMotion(MINI, GRID, points)(field).T
    np.testing.assert_allclose(y, 0, atol=1e-6)
    assert abs(x[0]) < 1e-6 and x[2] > 0.03e-3 and x[2] > 3 * x[1] > 0 and x[2] > 1.5 * x[3] > 0
    turned = GelMotion(MINI, GRID, points[:, ::-1])(field)
    np.testing.assert_allclose(turned[:, 1], x, rtol=0.02, atol=1e-6)
