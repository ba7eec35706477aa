#!/usr/bin/env python3
"""Writes the tables of README.md that the code knows: `.venv/bin/python tools/readme_tables.py`.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. With --check nothing is written and the exit code is 1
if a table is out of date.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from hannes_description.signals import NAMESPACE, SIGNALS

README = Path(__file__).resolve().parent.parent / "README.md"


def topics() -> str:
    """One row per topic, with the fields that carry signals and their units."""
    rows = ["| topic | type | field, unit: meaning |", "|---|---|---|"]
    for topic in dict.fromkeys(signal.topic for signal in SIGNALS.values()):
        own = [signal for signal in SIGNALS.values() if signal.topic == topic]
        fields = "; ".join(f"`{s.field}`{', ' + s.unit if s.unit else ''}: {s.description}" for s in own)
        rows.append(f"| `{NAMESPACE}/{topic}` | {own[0].type.replace('/msg/', '/')} | {fields} |")
    return "\n".join(rows)


TABLES = {"topics": topics}


def renewed(text: str) -> str:
    """The text with every table made afresh."""
    for name, make in TABLES.items():
        pattern = rf"(<!-- table: {name} -->\n).*?(<!-- end -->)"
        table = make().replace("\\", r"\\")
        text, count = re.subn(pattern, rf"\g<1>{table}\n\g<2>", text, flags=re.DOTALL)
        if count != 1:
            raise SystemExit(f"README.md has {count} tables named {name}; it must have one.")
    return text


def main() -> int:
    old = README.read_text(encoding="utf-8")
    new = renewed(old)
    if "--check" in sys.argv[1:]:
        return int(new != old)
    README.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
