"""A node that visits a running graph for a moment and leaves no trace in it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.node import Node


@contextmanager
def visit(
    purpose: str, kind: type[Executor], context: Context | None = None
) -> Iterator[tuple[Node, Executor]]:
    """A hidden node and its executor; both end with the block, and so does the context unless one was given."""
    own = context is None
    if context is None:
        context = Context()
        rclpy.init(args=[], context=context)
    node = Node(
        f"_hannes_{purpose}_{os.getpid()}",
        context=context,
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
    )
    executor = kind(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        if own:
            rclpy.try_shutdown(context=context)
