"""Taking messages without an executor: one that is behind may so look at what has come, and sees when it was sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rclpy.subscription import Subscription


def taken(subscription: Subscription, most: int = 1000) -> Iterator[tuple[bytes, Mapping[str, Any]]]:
    """The serialised messages that have come, at most so many, each with the middleware's information on it.

    For subscriptions of a node that no executor serves. rclpy has no public way to do that.
    """
    handle, kind = subscription.handle, subscription.msg_type
    for _ in range(most):
        with handle:
            message = handle.take_message(kind, True)
        if message is None:
            return
        yield message
