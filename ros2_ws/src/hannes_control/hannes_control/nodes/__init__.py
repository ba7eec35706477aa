"""What the nodes of this package are made of: the only files beside `*_node.py` that import ROS 2."""
