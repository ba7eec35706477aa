"""docs/equations.md, written down once more from the page alone, moves as the simulator does."""

import numpy as np
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_lab.hand import make_controller
from hannes_sim.factory import make_plant
from hannes_sim.objects import named_object
from hannes_sim.rollout import rollout

STEP = 0.25e-3


def dry(momentum: float, impulse: float, inertia: float) -> float:
    """Velocity after friction that takes at most an impulse, and never turns the motion."""
    return float(np.sign(momentum) * max(abs(momentum) - impulse, 0.0) / inertia)


def of_the_page(
    model: Model, reference: np.ndarray, stiffness: float, damping: float, size: float
) -> np.ndarray:
    """Encoder position and current (n, 2) at each control period."""
    p = {name: model.parameters.value(name) for name in model.names}
    ratio, tip, rounded = p["gear.ratio"], p["hand.fingertip_travel"], p["encoder.resolution"]
    rotor, kt = p["motor.armature"] * ratio**2, p["motor.kt"]
    k, c, place = stiffness * tip**2, damping * tip**2, (p["hand.opening"] - size) / tip
    decay = np.exp(-p["motor.resistance"] / p["motor.inductance"] * STEP)
    q = w = ql = wl = i = velocity = integral = 0.0
    last, out = 0.0, []
    for wanted in reference:
        position = np.floor(q / rounded + 0.5) * rounded
        velocity += 1e-3 / (1e-3 + p["control.velocity_filter"]) * ((position - last) / 1e-3 - velocity)
        last = position
        limit = p["motor.current_limit"]
        i_ref = p["control.kp"] * (wanted - position) - p["control.damping"] * velocity
        error = min(max(i_ref, -limit), limit) - i
        asked = p["control.current_kp"] * error + integral + p["control.current_ki"] * 1e-3 * error
        volts = min(max(asked, -p["supply.voltage"]), p["supply.voltage"])
        if asked == volts or asked * error < 0.0:
            integral += p["control.current_ki"] * 1e-3 * error
        out.append((position, i))
        for _ in range(round(1e-3 / STEP)):
            end = (volts - kt * ratio * w) / p["motor.resistance"]
            mean = end + (i - end) * (1.0 - decay) / -np.log(decay)
            i = end + (i - end) * decay
            stretch = q - ql
            pull = p["wire.stiffness"] * stretch + p["wire.damping"] * (w - wl)
            tension = max(0.0, pull) if stretch > 0.0 else 0.0
            stop = p["hand.stop_stiffness"] * (min(ql, 0.0) + max(ql - p["hand.travel"], 0.0))
            force = tension - p["hand.preload"] - p["hand.stiffness"] * ql - stop
            inertia = p["hand.inertia"] + STEP * p["hand.viscous"]
            momentum, impulse = p["hand.inertia"] * wl + STEP * force, STEP * p["hand.coulomb"]
            wl = dry(momentum, impulse, inertia)
            depth = ql - place
            if depth > 0.0:
                pressed = dry(momentum - STEP * k * depth, impulse, inertia + STEP * c)
                wl = pressed if k * depth + c * pressed > 0.0 else wl
            ql += STEP * wl
            torque = p["gear.efficiency"] * kt * ratio * mean
            momentum = rotor * w + STEP * (torque - tension)
            w = dry(momentum, STEP * p["friction.coulomb"], rotor + STEP * p["friction.viscous"])
            q += STEP * w
    return np.array(out)


def test_the_page_holds_the_equations_that_are_simulated() -> None:
    model, soft = Model.load(), named_object("soft")
    assert soft is not None
    reference = half_sine(1, 13.0, 2.0, 1e-3)
    run = rollout(make_plant(model, soft), make_controller(model, 1e-3), reference)
    page = of_the_page(model, reference, soft.stiffness, soft.damping, soft.size)
    assert np.abs(page[:, 0] - run.encoder_position).max() < 2.0 * model.parameters.value(
        "encoder.resolution"
    )
    assert np.abs(page[:, 1] - run.motor_current).max() < 0.02
    assert np.ptp(run.motor_current) > 0.5
