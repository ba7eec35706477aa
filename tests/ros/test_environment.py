"""The middleware's settings: who hears the nodes, and that no shared memory is used."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path
from xml.etree import ElementTree

import pytest
from graph import NodeProcess, processes
from hannes_bringup.environment import ros_environment
from patience import PATIENCE

RANGE, PROFILES = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"

# A node that was started without any setting of this project's, as from a terminal with ROS 2 sourced
LISTENER = """
    import time, rclpy
    from std_msgs.msg import Float64

    rclpy.init()
    node, heard = rclpy.create_node("listener"), []
    node.create_subscription(Float64, "/hannes/motor/current", heard.append, 10)
    end = time.monotonic() + {patience}
    while not heard and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    print("heard" if heard else "nothing")
"""


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, ("SYSTEM_DEFAULT", "fastdds_localhost.xml")),
        ({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}, ("SYSTEM_DEFAULT", "fastdds_localhost.xml")),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, ("LOCALHOST", "fastdds.xml")),
        ({RANGE: "SUBNET"}, ("SUBNET", "fastdds.xml")),
        ({PROFILES: "/mine/own.xml"}, ("LOCALHOST", "own.xml")),
    ],
)
def test_nodes_stay_on_this_machine_unless_the_user_says_otherwise(
    given: dict[str, str], expected: tuple[str, str]
) -> None:
    environment = ros_environment({"HOME": "/nonexistent", **given})
    assert (environment[RANGE], Path(environment[PROFILES]).name) == expected
    assert given.items() <= environment.items()
    assert ros_environment(environment) == environment


@pytest.mark.parametrize("range_", ["", "SUBNET", "LOCALHOST"])
def test_who_waits_for_a_hand_says_where_only_this_machine_is_heard(
    ros_environment: dict[str, str], range_: str
) -> None:
    plain = {name: value for name, value in ros_environment.items() if name not in (RANGE, PROFILES)}
    child = subprocess.Popen(
        [sys.executable, "-m", "hannes_bringup.cli", "run", "motor_controller"],
        env={**plain, **({RANGE: range_} if range_ else {})},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert child.stdout is not None
        said = next(line for line in child.stdout if "waiting for motor/state" in line)
    finally:
        child.terminate()
        child.communicate()
    assert ("ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET hears them" in said) == (range_ != "SUBNET"), said


def test_both_profiles_find_and_forget_nodes_and_repair_losses_alike() -> None:
    local = Path(ros_environment({})[PROFILES])
    found = [
        [
            "".join(ElementTree.tostring(part, encoding="unicode").split())
            for name in ("leaseDuration", "leaseAnnouncement", "initialAnnouncements", "heartbeatPeriod")
            for part in ElementTree.parse(profile).getroot().iterfind(f".//{{*}}{name}")
        ]
        for profile in (local, local.with_name("fastdds.xml"))
    ]
    assert len(found[0]) == 4 and found[0] == found[1]


@pytest.mark.parametrize("range_", ["SUBNET", "LOCALHOST"])
def test_heard_by_a_node_with_ros_own_settings(
    ros_environment: dict[str, str], tmp_path: Path, range_: str
) -> None:
    unset = {RANGE, PROFILES, "FASTDDS_BUILTIN_TRANSPORTS"}
    plain = {name: value for name, value in ros_environment.items() if name not in unset}
    script = tmp_path / "listener.py"
    script.write_text(textwrap.dedent(LISTENER.format(patience=PATIENCE)))
    with processes(NodeProcess("hand_sim", clock="realtime")) as (sim,):
        heard = subprocess.run(
            [sys.executable, str(script)], env={**plain, RANGE: range_}, capture_output=True, text=True
        )
        assert heard.stdout.strip() == "heard", heard.stderr
        maps = Path(f"/proc/{sim.process.pid}/maps").read_text()
    assert "/dev/shm/fastrtps" not in maps
