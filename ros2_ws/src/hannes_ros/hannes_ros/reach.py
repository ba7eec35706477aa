"""How far this process hears: what `hannes` starts stays on its machine unless the user says otherwise."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

LOCAL_PROFILE = "fastdds_localhost.xml"
WIDER = "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"


def not_beyond(environment: Mapping[str, str] | None = None) -> str:
    """What to add where somebody is missed, who may be on another machine; empty where such are heard."""
    given = os.environ if environment is None else environment
    profile = Path(given.get("FASTRTPS_DEFAULT_PROFILES_FILE", "")).name
    local = given.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST" or profile == LOCAL_PROFILE
    return f" (nodes on other machines are not heard: {WIDER} hears them)" if local else ""
