"""What the verdict's card says of how sure the answer is, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from . import report_text as text
from .experiments import VISIBLE

Part = Mapping[str, Any]

SHOWN = 4
"""Effects whose main parameter the card shows; all stand in their section."""

OWN_EFFECT = "my_effect.py:MyEffect"


def next_step(kind: str, diagnosis: Part | None, command: str) -> dict[str, str] | None:
    """What to do after this answer, in a few words, and the command for it; None where the command is not known.

    kind     of the verdict: nothing, effects, unknown, added or comparison
    command  what made the report
    """
    try:
        words = shlex.split(command)
    except ValueError:
        return None
    if len(words) < 3 or words[0] != "hannes":
        return None
    tied = (diagnosis or {}).get("tied") or []
    if kind == "effects" and len(tied) > 1:
        return _experiment((diagnosis or {}).get("experiments") or [])
    if kind == "comparison" and words[1] == "compare":
        rest = [w for w in _without(words[2:], "--report") if w not in ("--fitted", "--json")]
        return {"text": "Ask what the model lacks", "command": shlex.join(["hannes", "diagnose", *rest])}
    if kind == "added" or (kind == "effects" and "--add" in words):
        return None if "--rig" in words else _run(words)
    if kind not in ("effects", "unknown") or words[1] not in ("diagnose", "report"):
        return None
    if words[1] == "report":
        words = ["hannes", "diagnose", *("--report" if w == "--out" else w for w in words[2:])]
    if kind == "effects":
        return {"text": "Write the model with it to a file", "command": shlex.join([*words, "--add"])}
    if (diagnosis or {}).get("unknown_kind") == "no_repeats":
        return {
            "text": "Record each motion five times or more: only repeats tell what is scatter",
            "command": "",
        }
    ranking = (diagnosis or {}).get("ranking") or []
    if (diagnosis or {}).get("unknown_kind") == "not_foretold" and ranking:
        return _explains_most(words, max(ranking, key=lambda r: text.known(r.get("explained")) or 0.0))
    return {
        "text": "Write down what you suspect as an effect of your own, and let it take part",
        "command": shlex.join([*words, "--effect", OWN_EFFECT]),
    }


def _explains_most(words: Sequence[str], rank: Part) -> dict[str, str]:
    """Adding the effects that explain most of the fit, though conditions do not foretell one another with them."""
    rest = [w for w in words[2:] if w not in ("--greedy", "--no-greedy", "--json", "--add")]
    for option in ("--max-effects", "--only", "--effect", "--out"):
        rest = _without(rest, option)
    names = [str(name) for name in rank.get("names", [])]
    given = [word for name in names for word in ("--effect", name)]
    return {
        "text": f"See what {text.listed([text.words(n) for n in names])} does to closures that were left out",
        "command": shlex.join(["hannes", "add", *rest, *given]),
    }


def _run(words: Sequence[str]) -> dict[str, str]:
    """The model file of --add, in the node graph."""
    out = "my_hand.yaml"
    for k, word in enumerate(words):
        if word == "--out" and k + 1 < len(words):
            out = words[k + 1]
        elif word.startswith("--out="):
            out = word.removeprefix("--out=")
    return {
        "text": "Run the node graph with the model that has it",
        "command": shlex.join(["hannes", "run", "graph", "--model", out]),
    }


def _experiment(experiments: Sequence[Part]) -> dict[str, str]:
    """The first experiment that separates tied sets."""
    best = next((x for x in experiments if (text.known(x.get("distance")) or 0.0) >= VISIBLE), None)
    if best is None:
        return {
            "text": "No experiment that was considered tells them apart: choose by what you know of the machine",
            "command": "",
        }
    return {
        "text": f"Record what tells them apart ({text.words(best.get('name', ''))}), then diagnose again",
        "command": str(best.get("command", "")),
    }


def _without(words: Sequence[str], option: str) -> list[str]:
    """The words without an option and its value."""
    out: list[str] = []
    skip = False
    for word in words:
        if skip or word.startswith(f"{option}="):
            skip = False
        elif word == option:
            skip = True
        else:
            out.append(word)
    return out


def how_sure(effects: Sequence[Part]) -> list[dict[str, Any]]:
    """Of each effect the main parameter, which comes first, with its interval; of many effects the first ones."""
    rows = [(e["title"], p) for e in effects for p in e["parameters"][:1]]
    return [{"title": title, **p} for title, p in rows[:SHOWN]]


def runner_up(ranking: Part | None, diagnosis: Part | None) -> dict[str, Any] | None:
    """The best effect that is neither in the verdict nor tied with it, and the part that it explains alone.

    None where there is no excess of misfit to explain, or where nothing was repeated: a share of a guess is none.
    """
    falls = (diagnosis or {}).get("falls") or [{}]
    if ranking is None or not ranking["excess"] or text.known(falls[-1].get("held_out")) is None:
        return None
    tied = {" + ".join(text.words(n) for n in names) for names in (diagnosis or {}).get("tied") or []}
    rows = [*ranking["first"], *ranking["rest"]]
    best = next((r for r in rows if not r["found"] and r["label"] not in tied), None)
    own = [r for r in rows if r["found"]]
    if best is None or best["explained"] is None:
        return None
    return {"label": best["label"], "explained": best["explained"], "own": own[0] if own else None}
