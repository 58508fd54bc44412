"""Works one block ahead: reads the next block while the present one is used."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Block = TypeVar("Block")


def ahead(blocks: Iterator[Block]) -> Iterator[Block]:
    """The same blocks; each is made in another thread while the one before it is used.

    An exception of `blocks` is raised here when its block is due.
    """
    end = object()
    with ThreadPoolExecutor(1) as thread:
        pending = thread.submit(next, blocks, end)
        while (block := pending.result()) is not end:
            pending = thread.submit(next, blocks, end)
            yield block  # type: ignore[misc]  # `end` is not yielded
