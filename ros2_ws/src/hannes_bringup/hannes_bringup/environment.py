"""The environment variables of ROS 2 processes, with safe values where the user gave none."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from hannes_description.errors import HannesError
from hannes_ros.reach import LOCAL_PROFILE

_RANGE, _PROFILES = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"
_CONFIG = Path(__file__).parent / "config"
_LOCAL, _ANY = _CONFIG / LOCAL_PROFILE, _CONFIG / "fastdds.xml"


def _takes_profile(environment: Mapping[str, str]) -> bool:
    """Whether the middleware is Fast DDS (that of Jazzy) without profiles of the user's."""
    fast_dds = environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
    return fast_dds and _PROFILES not in environment


def ros_environment(base: Mapping[str, str] | None = None) -> dict[str, str]:
    """A copy of `base` (default: this process's environment) in which ROS 2 nodes can start.

    AMENT_PREFIX_PATH              this Python environment, where ROS 2 came as wheels and nothing is sourced
    ROS_AUTOMATIC_DISCOVERY_RANGE  nodes on other machines neither see nor drive the hand. With Fast DDS this is done by
                                   config/fastdds_localhost.xml, which must not be overruled (SYSTEM_DEFAULT): with
                                   LOCALHOST, ROS always takes shared memory, in which a stopped process goes deaf
    FASTDDS_BUILTIN_TRANSPORTS     UDPv4, for a range that the user chose: after a kill -9 the shared memory left behind
                                   stalls discovery for seconds
    FASTRTPS_DEFAULT_PROFILES_FILE config/: nodes find each other at once on a busy machine, too
    ROS_LOG_DIR                    a temporary folder, where the home folder cannot be written

    What the user has set is kept.
    """
    environment = dict(os.environ if base is None else base)
    if not environment.get("AMENT_PREFIX_PATH") and (Path(sys.prefix) / "share" / "ament_index").is_dir():
        environment["AMENT_PREFIX_PATH"] = sys.prefix
    ours = _LOCAL if _RANGE not in environment and _takes_profile(environment) else _ANY
    environment.setdefault(_RANGE, "SYSTEM_DEFAULT" if ours is _LOCAL else "LOCALHOST")
    environment.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    environment.setdefault(_PROFILES, str(ours))
    if "ROS_LOG_DIR" not in environment and "ROS_HOME" not in environment:
        home = Path(environment.get("HOME") or "/nonexistent")
        if not os.access(home / ".ros" if (home / ".ros").exists() else home, os.W_OK):
            environment["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir()) / f"ros_log_{os.getuid()}")
    return environment


def apply_ros_environment() -> None:
    """Give this process the environment of `ros_environment`; call it before the first import of rclpy."""
    os.environ.update(ros_environment())


def require_ros() -> None:
    """Raise HannesError with what to do if this Python has no ROS 2."""
    if find_spec("rclpy") is None:
        raise HannesError(
            "ROS 2 is not in this Python environment. Run `make setup` in the repository (it installs ROS 2 Jazzy "
            "from wheels), or source /opt/ros/jazzy/setup.bash and run `make setup` again."
        )
