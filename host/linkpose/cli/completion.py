"""Completion in bash of words with a colon, such as sim://link: bash and click take each for several words."""

from __future__ import annotations

import os
from typing import Any

from click.shell_completion import BashComplete, CompletionItem, add_completion_class, split_arg_string


class BashOfLine(BashComplete):
    """Completes from the line up to the cursor instead of from bash's words."""

    def source(self) -> str:
        return super().source().replace('"${COMP_WORDS[*]}"', '"${COMP_LINE:0:$COMP_POINT}"')

    def get_completion_args(self) -> tuple[list[str], str]:
        line = os.environ["COMP_WORDS"]
        words = split_arg_string(line)
        incomplete = "" if line[-1:].isspace() else words.pop()
        self._typed = incomplete.rpartition("=")[2]
        return words[1:], incomplete

    def format_completion(self, item: CompletionItem[Any]) -> str:
        """As click does, without what bash keeps: what is typed up to the last colon."""
        kept = self._typed[: self._typed.rfind(":") + 1]
        return f"{item.type},{item.value.removeprefix(kept)}"


def register() -> None:
    """Makes click use this completion in bash."""
    add_completion_class(BashOfLine)
