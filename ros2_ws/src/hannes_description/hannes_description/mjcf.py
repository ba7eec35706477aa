"""The hand as a MuJoCo model, built from the parameters.

Coordinates (variant transmission="wires"): a slide `motor` [m] is the wire that the pulley has taken up, its
mass the rotor's inertia / radius^2.  Two carts on guides, c1 (index and middle) and c2 (ring and little), are
movable pulleys of the master wire:

    master   x_motor - 2 c1 - 2 c2 - w_thumb               <= 0
    slave    c_j - (rb w_a + ra w_b) / (ra + rb)           <= 0        (thesis P14)
    w        = sum of flexor arm x joint angle, per digit

so a master tension F gives each cart 2F, finger a rb/(ra+rb) 2F, finger b ra/(ra+rb) 2F and the thumb F.
Wires are fixed tendons with an upper limit: they pull, stretch by F/K, and go slack.

transmission="forces": no carts, no limits and nothing that can go slack.  One fixed tendon `drive`, x_motor less
the sum of all wires at equal tension, is held at zero by an equality of the master wire's stiffness, so that the
motor's force goes to the joints in the same shares, pushing as well as pulling.  (A tendon armature on the joints
alone would not do: MuJoCo keeps its couplings only within a kinematic tree, and every finger is a tree; the rotor
would feel five times too light.)

return_mechanism="return_wire": a dorsal wire over MCP and PIP, T = preload + rate x (arms x angles);
"torsion_spring": one spring per joint, M = M0 + k q, with the same moment at the open hand and at full flexion.

Contacts, wires and stops have their stiffness in N/m and N.m/rad (`direct_solref`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np

from .errors import HannesError
from .joints import DIGITS, FINGERS, JOINT_LIMITS
from .kinematics import Link, Parameters, check_thumb_stop, links, quaternion, value

RETURN_MECHANISMS = ("return_wire", "torsion_spring")
TRANSMISSIONS = ("wires", "forces")

MOTOR = "motor"
MASTER, SLAVES, DRIVE = "master", ("slave_index_middle", "slave_ring_little"), "drive"
CARTS = ("cart_index_middle", "cart_ring_little")
PAIRS: tuple[tuple[str, str], tuple[str, str]] = (("index", "middle"), ("ring", "little"))

# Impedance of the constraints.  A row adds the virtual mass d / ((1 - d) A) to its own stretch (not to the common
# motion of what it connects); it keeps light carts and fingers stable up to a step of 0.4 ms, and leaves stiffness and
# damping exact.
WIRE_IMPEDANCE, STOP_IMPEDANCE = 0.9, 0.97

CONTACT_STEPS = 2.0
"""Virtual mass of a contact: K t^2 + B t with t this many integration steps."""

FRICTION_SOLREF, FRICTION_SOLIMP = (0.0005, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Dry friction: the creep speed under a load f is f A (1 - d) / b; the defaults creep by degrees a second."""

GRASP_CENTRE = (0.062, 0.0, 0.097)
"""m, palm frame: middle of the space that fingers and thumb close on."""

BAR_HALF_LENGTH = 0.045
"""m; half the length of a capsule, box or prism across the fingers."""

PRISM_SIDES: Mapping[str, int] = {"prism": 6, "pentagon": 5}
"""Sides of the regular prisms by shape."""


class GraspShape(Protocol):
    """What the builder needs of an object to grasp (hannes_sim.objects.GraspObject)."""

    @property
    def shape(self) -> str: ...
    @property
    def size(self) -> float: ...
    @property
    def stiffness(self) -> float: ...
    @property
    def damping(self) -> float: ...
    @property
    def friction(self) -> float: ...
    @property
    def place(self) -> tuple[float, float, float]: ...


@dataclass(frozen=True)
class Variant:
    """Which mechanism is built; the errors list what is valid.

    return_mechanism  return_wire | torsion_spring
    transmission      wires | forces
    thumb_stop_deg    0 | -30 | -60, where the thumb's rotation is locked
    """

    return_mechanism: str = "return_wire"
    transmission: str = "wires"
    thumb_stop_deg: int = 0

    def __post_init__(self) -> None:
        if self.return_mechanism not in RETURN_MECHANISMS:
            raise HannesError(
                f"Return mechanism {self.return_mechanism!r} is unknown; valid are "
                f"{', '.join(RETURN_MECHANISMS)}."
            )
        if self.transmission not in TRANSMISSIONS:
            raise HannesError(
                f"Transmission {self.transmission!r} is unknown; valid are {', '.join(TRANSMISSIONS)}."
            )
        check_thumb_stop(self.thumb_stop_deg)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Variant:
        """From the options of a model file; unknown names are refused."""
        unknown = sorted(set(options) - set(cls.__dataclass_fields__))
        if unknown:
            raise HannesError(
                f"Variant: unknown options {', '.join(unknown)}; valid are "
                f"{', '.join(cls.__dataclass_fields__)}."
            )
        return cls(**dict(options))


def joints_of(digit: str) -> tuple[str, ...]:
    """The joints that a digit's wire flexes."""
    return ("thumb_abd",) if digit == "thumb" else (f"{digit}_mcp", f"{digit}_pip")


def wire_arms(parameters: Parameters) -> dict[str, float]:
    """Flexor moment arm [m] of every joint that a wire flexes."""
    return {joint: value(parameters, f"pulleys.{joint}") for digit in DIGITS for joint in joints_of(digit)}


def tension_shares(parameters: Parameters) -> dict[str, float]:
    """Wire tension of every digit per unit of master tension (thesis P14)."""
    shares = {"thumb": 1.0}
    for a, b in PAIRS:
        ra, rb = value(parameters, f"pulleys.{a}_lever"), value(parameters, f"pulleys.{b}_lever")
        shares[a], shares[b] = 2.0 * rb / (ra + rb), 2.0 * ra / (ra + rb)
    return shares


def transmission_jacobian(parameters: Parameters) -> dict[str, float]:
    """m of master wire per rad of every flexed joint while all wires are taut."""
    arms, shares = wire_arms(parameters), tension_shares(parameters)
    return {joint: shares[digit] * arms[joint] for digit in DIGITS for joint in joints_of(digit)}


def return_moments(parameters: Parameters) -> dict[str, tuple[float, float]]:
    """Torsion spring (M0 [N.m], k [N.m/rad]) of every flexed joint that replaces the return wires.

    M0 is the return wire's moment at the open hand; k gives its moment with the whole digit flexed (thesis R14).
    """
    out = {}
    for digit in DIGITS:
        joints = joints_of(digit)
        arms = {joint: value(parameters, f"springs.{joint}_arm") for joint in joints}
        travel = sum(arms[joint] * JOINT_LIMITS[joint].upper for joint in joints)
        preload, rate = (
            value(parameters, f"springs.{digit}_preload"),
            value(parameters, f"springs.{digit}_rate"),
        )
        for joint in joints:
            out[joint] = (preload * arms[joint], rate * travel * arms[joint] / JOINT_LIMITS[joint].upper)
    return out


def reflected_mass(parameters: Parameters) -> float:
    """kg at the wire: rotor inertia x gear ratio^2 / pulley radius^2."""
    ratio, radius = value(parameters, "gear.ratio"), value(parameters, "pulley.radius")
    return value(parameters, "motor.armature") * (ratio / radius) ** 2


def direct_solref(stiffness: float, damping: float, impedance: float, weight: float) -> tuple[float, float]:
    """MuJoCo's direct solref for a constraint force K r + B r' with K in N/m (or N.m/rad).

    weight = the inverse inertia A that the compiler assigned to the constraint.  With a constant impedance d the row's
    force is (aref - a) / R, R = A (1 - d) / d and aref = -(k / d) r - (b / d) r' (MuJoCo, "Solver parameters"); so
    k = K (1 - d) A and b = B (1 - d) A, exact at rest whatever else moves with the row.
    """
    return -stiffness * (1.0 - impedance) * weight, -damping * (1.0 - impedance) * weight


def contact_impedance(stiffness: float, damping: float, weight: float, dt: float) -> float:
    """Impedance of one digit's contact of K [N/m] and B [N.s/m]: the least virtual mass that keeps it stable.

    The mass K t^2 + B t, t = CONTACT_STEPS dt, is a fraction of a gram on a soft object.  A larger one would turn the
    jerk of a finger that strikes its own stop into a spike of the grip force: the mass times the jerk, sideways too,
    and MuJoCo's friction cone raises the normal force with the sideways one.
    """
    t = CONTACT_STEPS * dt
    ratio = weight * t * (stiffness * t + damping)
    return min(max(ratio / (1.0 + ratio), 1e-4), 0.9999)  # MuJoCo's own limits of an impedance


def contact_stiffness(grasp: GraspShape) -> tuple[float, float]:
    """Stiffness [N/m] and damping [N.s/m] of one digit's contact; five digits share the object's."""
    return grasp.stiffness / len(DIGITS), grasp.damping / len(DIGITS)


def _flat(impedance: float) -> list[float]:
    return [impedance, impedance, 0.001, 0.5, 2.0]


def build_spec(
    parameters: Parameters,
    variant: Variant | Mapping[str, Any] | None = None,
    grasp: GraspShape | None = None,
) -> mujoco.MjSpec:
    """The model's specification, with every stiffness mapped; `.compile()` gives the mjModel.

    parameters  a ParameterSet or mapping of dotted names to Parameter: groups geometry, inertia, gravity, pulleys,
                springs, joints, carts, wires, motor, gear, pulley, friction
    variant     see Variant; None is the return-wire and wires variant at stop 0
    grasp       the object in the hand, fixed in the palm frame, or None
    Raises HannesError for a missing parameter or an unknown variant.
    """
    chosen = variant if isinstance(variant, Variant) else Variant.of(variant or {})

    def v(name: str) -> float:
        return value(parameters, name)

    spec = mujoco.MjSpec()
    spec.modelname = "hannes"
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    option = spec.option
    option.timestep = 0.25e-3
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations = 30
    option.ls_iterations = 50
    option.tolerance = 1e-8
    option.gravity = [v("gravity.palmar"), v("gravity.radial"), v("gravity.distal")]
    disable = mujoco.mjtDisableBit
    # A divergence must show instead of being reset; islands and mid-phase cost more than they save in so small a model.
    flags = disable.mjDSBL_AUTORESET | disable.mjDSBL_ISLAND | disable.mjDSBL_MIDPHASE
    if grasp is None:
        # Only an object is touched; without one the search for contacts takes a seventh of a step.
        flags |= disable.mjDSBL_CONTACT
    option.disableflags = int(flags)

    _add_materials(spec)
    palm = spec.worldbody.add_body(name="base_link")
    _add_palm(palm, parameters)
    tree = links(parameters, chosen.thumb_stop_deg)
    bodies = {"base_link": palm}
    for link in tree:
        bodies[link.name] = _add_link(bodies[link.parent], link, parameters)
    _add_return(spec, parameters, chosen)
    _add_motor(palm, parameters)
    if chosen.transmission == "wires":
        _add_wires(spec, palm, parameters)
    else:
        _add_drive(spec, parameters)
    if grasp is not None:
        _add_object(spec, grasp, tree)
    _map_stiffness(spec, parameters, chosen, grasp)
    return spec


def _add_materials(spec: mujoco.MjSpec) -> None:
    for name, rgba, shininess in (
        ("shell", (0.80, 0.81, 0.83, 1), 0.5),
        ("palm", (0.24, 0.26, 0.30, 1), 0.3),
        ("joint", (0.14, 0.15, 0.17, 1), 0.6),
        ("pad", (0.90, 0.54, 0.30, 1), 0.1),
        ("object", (0.24, 0.55, 0.72, 0.80), 0.4),
    ):
        spec.add_material(name=name, rgba=list(rgba), shininess=shininess, specular=shininess)


def _visual(body: Any, kind: Any, material: str, **where: Any) -> None:
    body.add_geom(type=kind, material=material, contype=0, conaffinity=0, mass=0.0, group=2, **where)


def _add_palm(palm: Any, parameters: Parameters) -> None:
    """Shape only: metacarpals, back, heel and wrist, so that a picture looks like a hand."""
    capsule, ellipsoid = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_ELLIPSOID
    for finger in FINGERS:
        x, y, z = (value(parameters, f"geometry.{finger}_{axis}") for axis in "xyz")
        radius = value(parameters, f"geometry.{finger}_radius")
        _visual(
            palm,
            capsule,
            "palm",
            fromto=[x, y, z - 0.003, 0.6 * x - 0.001, 0.62 * y, 0.020],
            size=[1.22 * radius, 0, 0],
        )
        _visual(palm, mujoco.mjtGeom.mjGEOM_SPHERE, "joint", pos=[x, y, z], size=[1.12 * radius, 0, 0])
    _visual(palm, ellipsoid, "palm", pos=[-0.002, 0.0, 0.058], size=[0.0145, 0.040, 0.048])
    _visual(palm, ellipsoid, "palm", pos=[0.002, -0.020, 0.040], size=[0.0165, 0.020, 0.036])
    tx, ty, tz = (value(parameters, f"geometry.thumb_{axis}") for axis in "xyz")
    _visual(
        palm,
        capsule,
        "palm",
        fromto=[0.004, 0.012, 0.016, 0.85 * tx, 0.92 * ty, 0.95 * tz],
        size=[0.0135, 0, 0],
    )
    _visual(palm, mujoco.mjtGeom.mjGEOM_SPHERE, "joint", pos=[tx, ty, tz], size=[0.0125, 0, 0])
    _visual(
        palm, mujoco.mjtGeom.mjGEOM_CYLINDER, "joint", fromto=[0, 0, -0.012, 0, 0, 0.004], size=[0.0225, 0, 0]
    )
    _visual(
        palm,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        "shell",
        fromto=[0, 0, -0.050, 0, 0, -0.012],
        size=[0.0245, 0, 0],
    )


def _add_link(parent: Any, link: Link, parameters: Parameters) -> Any:
    body = parent.add_body(name=link.name, pos=list(link.position), quat=list(quaternion(link.rpy)))
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = link.mass, [0.0, 0.0, link.com], list(link.inertia)
    if link.joint is not None:
        joint = body.add_joint(
            name=link.joint.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=list(link.joint.axis),
            limited=True,
            range=[link.joint.limit.lower, link.joint.limit.upper],
        )
        joint.solref_friction, joint.solimp_friction = list(FRICTION_SOLREF), list(FRICTION_SOLIMP)
        joint.solimp_limit = _flat(STOP_IMPEDANCE)
        if link.length == 0.0:
            _scalar(joint, "stiffness", value(parameters, "springs.abd_stiffness"))
            _scalar(joint, "damping", value(parameters, "joints.abd_damping"))
        else:
            arm = value(parameters, f"pulleys.{link.joint.name}")
            joint.frictionloss = value(parameters, "joints.friction_tension") * arm
            _scalar(joint, "damping", value(parameters, "joints.damping_tension") * arm**2)
    if link.length > 0.0:
        _add_shape(body, link)
    return body


def _add_shape(body: Any, link: Link) -> None:
    # The capsule `<link>` is what touches objects; its round end lies at the finger's end.
    end = link.length + link.overhang - (link.radius if link.overhang else 0.0)
    material = "shell"
    body.add_geom(
        name=link.name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, 0, 0, end],
        size=[link.radius, 0, 0],
        mass=0.0,
        contype=0,
        conaffinity=0,
        material=material,
        group=1,
    )
    _visual(
        body,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        "joint",
        size=[0.80 * link.radius, 0, 0],
        fromto=[0, -1.06 * link.radius, 0, 0, 1.06 * link.radius, 0],
    )
    if link.overhang:
        _visual(
            body,
            mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            "pad",
            pos=[0.30 * link.radius, 0, link.length - 0.004],
            size=[0.76 * link.radius, 0.74 * link.radius, 1.25 * link.radius],
        )


def _scalar(element: Any, name: str, number: float) -> None:
    """Set the linear coefficient of a polynomial attribute (a scalar in releases that have no polynomials)."""
    try:
        setattr(element, name, [number, 0.0, 0.0])
    except TypeError:
        setattr(element, name, number)


def _add_return(spec: mujoco.MjSpec, parameters: Parameters, variant: Variant) -> None:
    if variant.return_mechanism == "torsion_spring":
        for name, (moment, rate) in return_moments(parameters).items():
            joint = spec.joint(name)
            if rate <= 0.0:
                raise HannesError(f"The torsion spring of {name} needs a rate above 0; raise springs.*_rate.")
            _scalar(joint, "stiffness", rate)
            joint.springref = -moment / rate
        return
    for digit in DIGITS:
        # The coefficients are negative, so that a positive spring length is the preload and the wire pulls the
        # digit open: force = rate (springlength - length), springlength = preload / rate.
        preload, rate = (
            value(parameters, f"springs.{digit}_preload"),
            value(parameters, f"springs.{digit}_rate"),
        )
        if rate <= 0.0:
            raise HannesError(f"The return wire needs springs.{digit}_rate above 0, not {rate} N/m.")
        tendon = spec.add_tendon(name=f"return_{digit}", limited=False)
        _scalar(tendon, "stiffness", rate)
        tendon.springlength = [preload / rate, preload / rate]
        for joint in joints_of(digit):
            tendon.wrap_joint(joint, -value(parameters, f"springs.{joint}_arm"))


def _slide(palm: Any, name: str, place: tuple[float, float, float], mass: float) -> Any:
    """A body without shape on a guide along the palm (proximal is positive), not moved by gravity."""
    body = palm.add_body(name=name, pos=list(place), gravcomp=1.0)
    body.explicitinertial = True
    body.mass, body.inertia = mass, [1e-7, 1e-7, 1e-7]
    joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0.0, 0.0, -1.0])
    joint.solref_friction, joint.solimp_friction = list(FRICTION_SOLREF), list(FRICTION_SOLIMP)
    return joint


def _add_motor(palm: Any, parameters: Parameters) -> None:
    # The rotor is a mass, not an armature: the compiler leaves the armature out of the constraint weights, and the
    # motor's dry friction would creep at centimetres a second.
    radius = value(parameters, "pulley.radius")
    motor = _slide(palm, MOTOR, (0.0, 0.0, 0.0), reflected_mass(parameters))
    motor.limited = False
    motor.frictionloss = value(parameters, "friction.coulomb") / radius
    _scalar(motor, "damping", value(parameters, "friction.viscous") / radius**2)


def _add_wires(spec: mujoco.MjSpec, palm: Any, parameters: Parameters) -> None:
    def v(name: str) -> float:
        return value(parameters, name)

    for name, side in zip(CARTS, (0.01, -0.01), strict=True):
        cart = _slide(palm, name, (0.0, side, 0.05), v("carts.mass"))
        cart.limited, cart.range = True, [0.0, v("carts.travel")]
        cart.solimp_limit = _flat(STOP_IMPEDANCE)
        _scalar(cart, "stiffness", v("carts.stiffness"))
        cart.springref = -v("carts.preload") / v("carts.stiffness") if v("carts.stiffness") > 0.0 else 0.0
        _scalar(cart, "damping", v("carts.damping"))
        cart.frictionloss = v("carts.friction")
    arms, shares = wire_arms(parameters), tension_shares(parameters)
    master = _wire(spec, MASTER)
    master.wrap_joint(MOTOR, 1.0)
    for name in CARTS:
        master.wrap_joint(name, -2.0)
    master.wrap_joint("thumb_abd", -arms["thumb_abd"])
    for name, cart_name, pair in zip(SLAVES, CARTS, PAIRS, strict=True):
        slave = _wire(spec, name)
        slave.wrap_joint(cart_name, 1.0)
        for finger in pair:
            for joint in joints_of(finger):
                slave.wrap_joint(joint, -0.5 * shares[finger] * arms[joint])


def _wire(spec: mujoco.MjSpec, name: str) -> Any:
    # No tendon damping: it would push while the wire is slack.  The limit's own damping acts under tension only.
    return spec.add_tendon(name=name, limited=True, range=[-10.0, 0.0], solimp_limit=_flat(WIRE_IMPEDANCE))


def _add_drive(spec: mujoco.MjSpec, parameters: Parameters) -> None:
    drive = spec.add_tendon(name=DRIVE, limited=False)
    drive.wrap_joint(MOTOR, 1.0)
    for joint, arm in transmission_jacobian(parameters).items():
        drive.wrap_joint(joint, -arm)
    spec.add_equality(
        name=DRIVE,
        type=mujoco.mjtEq.mjEQ_TENDON,
        objtype=mujoco.mjtObj.mjOBJ_TENDON,
        name1=DRIVE,
        solimp=_flat(WIRE_IMPEDANCE),
    )


def _add_object(spec: mujoco.MjSpec, grasp: GraspShape, tree: tuple[Link, ...]) -> None:
    """The object on a fixed body, one explicit contact pair with every phalanx, and a sensor of the normal forces."""
    kinds = {
        "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
        "box": mujoco.mjtGeom.mjGEOM_BOX,
        "prism": mujoco.mjtGeom.mjGEOM_MESH,
        "pentagon": mujoco.mjtGeom.mjGEOM_MESH,
    }
    if grasp.shape not in kinds:
        raise HannesError(f"Object shape {grasp.shape!r} is unknown; valid are {', '.join(kinds)}.")
    place = [a + b for a, b in zip(GRASP_CENTRE, grasp.place, strict=True)]
    half = 0.5 * grasp.size
    across = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]  # the capsule's z along the palm's -y
    body = spec.worldbody.add_body(name="object", pos=place)
    shape: dict[str, Any] = {"size": [half, 0.0, 0.0]}
    if grasp.shape == "capsule":
        shape = {"size": [half, BAR_HALF_LENGTH, 0.0], "quat": across}
    elif grasp.shape == "box":
        shape = {"size": [half, BAR_HALF_LENGTH, half]}
    elif grasp.shape in PRISM_SIDES:
        spec.add_mesh(name="object", uservert=_prism(PRISM_SIDES[grasp.shape], half))
        shape = {"meshname": "object"}
    body.add_geom(
        name="object", type=kinds[grasp.shape], contype=0, conaffinity=0, material="object", group=0, **shape
    )
    body.add_site(name="object", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1.0, 0.0, 0.0], group=5)
    spec.add_sensor(
        name="grip_force",
        type=mujoco.mjtSensor.mjSENS_TOUCH,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="object",
    )
    for link in tree:
        if link.length > 0.0:
            spec.add_pair(
                name=f"object_{link.name}",
                geomname1="object",
                geomname2=link.name,
                condim=3 if grasp.friction > 0.0 else 1,
                friction=[max(grasp.friction, 1e-5)] * 2 + [0.0, 0.0, 0.0],
            )


def _prism(sides: int, radius: float) -> list[float]:
    """Corners (flat x, y, z) of a regular prism along y, one edge towards the fingertips' side (distal)."""
    angles = 2.0 * math.pi * np.arange(sides) / sides
    return [
        c
        for y in (-BAR_HALF_LENGTH, BAR_HALF_LENGTH)
        for a in angles
        for c in (radius * math.sin(a), y, radius * math.cos(a))
    ]


def _map_stiffness(
    spec: mujoco.MjSpec, parameters: Parameters, variant: Variant, grasp: GraspShape | None
) -> None:
    """Give stops, wires and contacts their stiffness: compile once for the constraint weights, then set solref."""

    def v(name: str) -> float:
        return value(parameters, name)

    if variant.transmission == "wires":
        for name in (MASTER, *SLAVES):
            spec.add_sensor(
                name=f"tension_{name}",
                type=mujoco.mjtSensor.mjSENS_TENDONLIMITFRC,
                objtype=mujoco.mjtObj.mjOBJ_TENDON,
                objname=name,
            )
    model = spec.compile()
    for joint in spec.joints:
        weight = float(model.dof_invweight0[model.joint(joint.name).dofadr[0]])
        if joint.limited:
            stiffness = v("carts.stop_stiffness" if joint.name in CARTS else "joints.stop_stiffness")
            # Critical damping of the joint's inertia 1/A and the row's virtual inertia together.
            critical = 2.0 * math.sqrt(stiffness / ((1.0 - STOP_IMPEDANCE) * weight))
            joint.solref_limit = list(
                direct_solref(stiffness, v("joints.stop_damping_ratio") * critical, STOP_IMPEDANCE, weight)
            )
    if variant.transmission == "wires":
        for name in (MASTER, *SLAVES):
            stiffness = v("wires.master_stiffness" if name == MASTER else "wires.slave_stiffness")
            weight = float(model.tendon_invweight0[model.tendon(name).id])
            spec.tendon(name).solref_limit = list(
                direct_solref(stiffness, v("wires.damping"), WIRE_IMPEDANCE, weight)
            )
    else:
        weight = float(model.tendon_invweight0[model.tendon(DRIVE).id])
        spec.equality(DRIVE).solref = list(
            direct_solref(v("wires.master_stiffness"), v("wires.damping"), WIRE_IMPEDANCE, weight)
        )
    if grasp is not None:
        stiffness, damping = contact_stiffness(grasp)
        for pair in spec.pairs:
            bodies = [model.geom(name).bodyid[0] for name in (pair.geomname1, pair.geomname2)]
            weight = float(np.sum(model.body_invweight0[bodies, 0]))
            impedance = contact_impedance(stiffness, damping, weight, spec.option.timestep)
            pair.solimp = _flat(impedance)
            pair.solref = list(direct_solref(stiffness, damping, impedance, weight))
