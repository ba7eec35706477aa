"""hannes_composed: the whole graph in one process, on one events executor.

The nodes, topics and parameters are those of the separate processes; give a parameter to one of them with its name in
front: `-p hand_sim:object:=soft`, and to all of them without, or use a parameter file with a section for each.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
from hannes_description.errors import HannesError
from hannes_ros.run import USAGE_ERROR, run_node

NODES = {
    "emg_source": "hannes_control.emg_source_node:EmgSource",
    "emg_reference": "hannes_control.emg_reference_node:EmgReferenceNode",
    "motor_controller": "hannes_control.motor_controller_node:MotorController",
    "hand_sim": "hannes_sim.sim_node:HandSim",
    "stiffness_classifier": "hannes_stiffness.stiffness_node:StiffnessNode",
    "recorder": "hannes_bags.recorder_node:RecorderNode",
}
"""Class of each node that can be composed."""

DEFAULT = ("emg_source", "emg_reference", "motor_controller", "stiffness_classifier", "hand_sim")
"""The nodes that are started unless told otherwise; what comes last finds the others' subscriptions in place."""


def chosen(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names of the nodes to start (`--nodes a,b,c`; DEFAULT without it) and the other arguments."""
    arguments = list(argv)
    if "--nodes" not in arguments:
        return list(DEFAULT), arguments
    at = arguments.index("--nodes")
    if at + 1 >= len(arguments):
        raise HannesError(f"--nodes needs a list with commas of {', '.join(NODES)}.")
    names = arguments[at + 1].split(",")
    unknown = [name for name in names if name not in NODES]
    if unknown:
        raise HannesError(f"There is no node '{unknown[0]}' to compose; valid are {', '.join(NODES)}.")
    return names, arguments[:at] + arguments[at + 2 :]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the nodes."""
    try:
        names, arguments = chosen(sys.argv if argv is None else argv)
    except HannesError as error:
        print(f"{os.path.basename(sys.argv[0])}: {error}", file=sys.stderr)
        sys.exit(USAGE_ERROR)
    sys.exit(run_node(*(NODES[name] for name in names), argv=arguments))


if __name__ == "__main__":
    main()
