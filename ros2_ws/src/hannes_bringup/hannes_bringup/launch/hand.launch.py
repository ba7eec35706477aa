"""`ros2 launch hannes_bringup hand.launch.py`: the same graph and arguments as hand.launch.yaml, which it includes."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource


def generate_launch_description() -> LaunchDescription:
    """Include the YAML file; its arguments (clock, object, model, emg, record, ...) are given as usual."""
    graph = Path(get_package_share_directory("hannes_bringup")) / "launch" / "hand.launch.yaml"
    return LaunchDescription([IncludeLaunchDescription(AnyLaunchDescriptionSource(str(graph)))])
