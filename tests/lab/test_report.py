"""The report and the picture from small dictionaries: every verdict, hostile texts, unknown numbers, no request."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hannes_description.errors import HannesError
from hannes_lab.compare import MetricRow
from hannes_lab.diagnosis import Fall, Rank
from hannes_lab.errors import SignalError
from hannes_lab.falls import fall_sentence
from hannes_lab.pictures import MAX_CONDITIONS, _heading, most_missed, write_picture
from hannes_lab.report import embedded_json, render_report, write_report
from hannes_lab.report_next import next_step, runner_up
from hannes_lab.report_text import (
    UNKNOWN,
    interval,
    number,
    percent,
    plus_minus,
    ratio,
    relative_error,
    signed_percent,
    unit,
)
from hannes_lab.wording import unforetold
from matplotlib.figure import Figure

NAN = math.nan
TIME = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
PHASE = ["void", "void", "hold", "hold", "opening", "opening"]


def make_comparison(*, off: float = 0.3, condition: str = "slow", closures: int = 13) -> dict[str, Any]:
    single = closures == 1
    measured = [0.0, 3.0, 9.0, 12.0, 6.0, 0.0]
    sd = 0.0 if single else 0.1
    floor = NAN if single else 0.05

    def ratio_of(rmse: float) -> float:
        return NAN if single else rmse / floor

    cells = [
        {
            "condition": condition,
            "signal": "encoder_position",
            "phase": p,
            "unit": "rad",
            "rmse": off,
            "bias": off,
            "repeatability": floor,
            "ratio": ratio_of(off),
            "p_value": NAN if single else 0.0005,
            "fails": not single and off > 0.1,
        }
        for p in ("void", "hold", "opening")
    ]
    return {
        "model": {"name": "nominal", "sha256": "ab" * 32},
        "fitted": True,
        "overall": ratio_of(off),
        "by_signal": {"encoder_position": off},
        "errors": [
            {
                "condition": condition,
                "signal": "encoder_position",
                "unit": "rad",
                "rmse": off,
                "repeatability": floor,
                "ratio": ratio_of(off),
            }
        ],
        "cells": cells,
        "overlays": [
            {
                "condition": condition,
                "signal": "encoder_position",
                "unit": "rad",
                "phase": PHASE,
                "time": TIME,
                "measured": measured,
                "low": [v - sd for v in measured],
                "high": [v + sd for v in measured],
                "model": [v + off for v in measured],
                "reference": measured,
            }
        ],
        "metrics": [
            {
                "condition": condition,
                "name": "closure_time",
                "unit": "s",
                "measured": 0.91,
                "sd": NAN if single else 0.012,
                "model": 0.95,
                "relative_error_percent": -4.4,
            }
        ],
        "depends_on": {
            "load": {
                "variable": "load",
                "unit": "mm",
                "signal": "encoder_position",
                "share": 0.52,
                "centres": [0.1, 0.2, 0.9],
                "curve": [0.01, -0.02, 0.05],
            },
            "direction": {
                "variable": "direction",
                "signal": "encoder_position",
                "share": 0.2,
                "centres": [-11.0, 0.0, 11.0],
                "curve": [0.01, 0.0, -0.01],
            },
            "time": {
                "variable": "time",
                "signal": "encoder_position",
                "share": 0.0,
                "centres": [],
                "curve": [],
            },
        },
        "data": [
            {
                "name": condition,
                "source": "bags/slow",
                "sha256": "cd" * 32,
                "conditions": [condition],
                "closures": closures,
                "signals": ["encoder_position"],
            }
        ],
        "notes": ["there is one condition only"],
    }


def make_fall(added: str, train: float, held_out: float) -> dict[str, Any]:
    return {
        "added": added,
        "train": train,
        "held_out": held_out,
        "by_condition": {"slow": held_out, "fast": NAN},
        "signals": [
            {
                "condition": "slow",
                "signal": "encoder_position",
                "unit": "rad",
                "rmse": 0.05 * held_out,
                "repeatability": 0.05,
                "ratio": held_out,
            }
        ],
    }


def make_effect(name: str = "glove_stiffness") -> dict[str, Any]:
    return {
        "name": name,
        "title": name.replace("_", " "),
        "source": None,
        "why": "It grows with the closing angle.",
        "parameters": {
            "stiffness": {
                "value": 0.0017743,
                "low": 0.0017166,
                "high": 0.001832,
                "unit": "N.m/rad",
                "identified": True,
            },
            "hardening": {"value": 5e-6, "low": 0.0, "high": 1e-4, "unit": "N.m/rad3", "identified": False},
        },
    }


def make_diagnosis(verdict: str) -> dict[str, Any]:
    effects = [] if verdict == "nothing" else [make_effect()]
    falls = [make_fall("nominal, as given", 57.6, 57.6), make_fall("nominal, fitted", 4.5, 4.6)]
    falls += [make_fall(e["name"], 0.9, 0.95) for e in effects]
    tied = [["glove_stiffness"], ["gravity"]] if verdict == "effects" else []
    return {
        "verdict": verdict,
        "summary": f"A summary of {verdict}.",
        "effects": effects,
        "tied": tied,
        "experiments": [
            {
                "name": "fast_void",
                "profile": "half_sine",
                "options": {"period": 1.5},
                "object": "none",
                "distance": 12.0,
                "separates": tied,
                "command": "hannes record --profile half_sine --option period=1.5 --object none",
            }
        ][: len(tied)],
        "error": {
            "nominal": 57.6,
            "final": falls[-1]["held_out"],
            "repeatability": 1.0,
            "held_out": True,
            "unit": "x",
        },
        "falls": falls,
        "ranking": [
            {"names": ["glove_stiffness"], "misfit": 945.0, "cost": 953.0, "explained": 0.9992},
            {"names": ["gravity"], "misfit": 1854.0, "cost": 1862.0, "explained": 0.41},
        ],
        "depends_on": make_comparison(off=0.01)["depends_on"],
        "chance": {"misfit": 907.0, "gain": 28.6, "median": 753.0, "draws": 400, "resampled": True},
        "costs": {
            "nominal_fitted": 700.0 if verdict == "nothing" else 244979.0,
            "critical_nominal": 900.0,
            "final": 700.0,
            "critical": 907.0,
        },
        "nuisances": {
            "motor.kt": {
                "value": 0.0162,
                "nominal": 0.0174,
                "prior_sds": -2.55,
                "low": 0.0161,
                "high": 0.0163,
            },
            "encoder.zero@slow": {
                "value": 0.033,
                "nominal": 0.0,
                "prior_sds": 10.6,
                "low": 0.0,
                "high": 0.04,
            },
        },
        "notes": ["stiffness and preload cannot be told apart well"],
        "simulations": 22777,
        "data": make_comparison()["data"],
        "model": {"name": "nominal", "sha256": "ab" * 32},
        "fitted_model": {"sha256": "ef" * 32},
    }


class Page(HTMLParser):
    """Elements, texts and ids of a page."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.style = ""
        self._inside = ""
        self.open: list[str] = []
        self.feed(source)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside = tag if tag in ("script", "style") else ""
        if tag == "script":
            self.scripts.append((dict(attrs), ""))
        if tag not in ("meta", "br", "line", "rect", "path"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            attrs, body = self.scripts[-1]
            self.scripts[-1] = (attrs, body + data)
        elif self._inside == "style":
            self.style += data
        else:
            self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    @property
    def ids(self) -> set[str | None]:
        return {attrs["id"] for _, attrs in self.elements if "id" in attrs}

    @property
    def data(self) -> dict[str, Any]:
        body = next(body for attrs, body in self.scripts if attrs.get("id") == "hannes-report-data")
        return json.loads(body, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def page_of(**parts: Any) -> Page:
    given = {
        "comparison": None,
        "after": None,
        "diagnosis": None,
        "title": "Test",
        "command": "hannes diagnose x",
    }
    page = Page(render_report(**{**given, **parts}))
    assert page.open == []
    return page


@pytest.mark.parametrize("kind", UNKNOWN)
def test_the_headline_does_not_say_what_nobody_can_tell(kind: str) -> None:
    told = {**make_diagnosis("unknown"), "unknown_kind": kind}
    page = page_of(comparison=make_comparison(), after=None, diagnosis=told)
    assert f"{UNKNOWN[kind]}." in page.words
    assert ("in the catalogue." in page.words) == (kind == "not_in_catalogue")
    assert ("Unknown effect" in page.words) == kind.startswith("not_")


@pytest.mark.parametrize(
    ("verdict", "headline"),
    [
        ("nothing", "Nothing is missing from the model."),
        ("effects", "The model lacks glove stiffness or gravity: these data cannot tell which."),
        ("unknown", "Something is missing that is not in the catalogue."),
    ],
)
def test_every_verdict(verdict: str, headline: str) -> None:
    after = None if verdict == "nothing" else make_comparison(off=0.05)
    page = page_of(comparison=make_comparison(), after=after, diagnosis=make_diagnosis(verdict))
    assert headline in page.words
    assert f"A summary of {verdict}." in page.words
    assert ("section", "verdict " + verdict) in {(t, a.get("class")) for t, a in page.elements}
    assert {
        "verdict",
        "fall",
        "overlays",
        "map",
        "depends",
        "ranking",
        "metrics",
        "nuisances",
        "data",
    } <= page.ids
    assert ("effects" in page.ids) == (verdict != "nothing")
    assert "hannes diagnose x" in page.words
    assert "cd" * 32 in page.words
    assert "nan" not in page.words.lower().replace("nano", "")


def test_a_frequency_is_named_where_it_is_clearest() -> None:
    """Of the model before and after: a few percent of what is left afterwards are at any frequency."""

    def at(hertz: float, share: float) -> dict[str, Any]:
        found = {
            "variable": "frequency",
            "unit": "Hz",
            "signal": "encoder_position",
            "share": share,
            "at": hertz,
        }
        return {"frequency": {**found, "centres": [1.0, 2.0, 6.0], "curve": [0.0, 0.2, 0.1]}}

    comparison = {**make_comparison(), "depends_on": at(2.3, 0.4)}
    after = {**make_comparison(off=0.05), "depends_on": at(6.0, 0.03)}
    words = page_of(comparison=comparison, after=after).words.replace("\u00a0", " ")
    assert "2.3 Hz" in words and ", 6.0 Hz" not in words


def test_what_the_page_shows_of_an_effect() -> None:
    page = page_of(
        comparison=make_comparison(), after=make_comparison(off=0.05), diagnosis=make_diagnosis("effects")
    )
    for part in (
        "1.774",
        "1.717 … 1.832",
        "10⁻³ N·m/rad",
        "not identified by these data",
        "The experiment that separates",
        "99.9 %",
        "+10.6",
        "hannes record --profile half_sine --option period=1.5 --object none",
        "−2.5",
        "57.6",
        "0.95",
        "0.910 ± 0.012",
        "−4.4 %",
        "3 of 3 beyond chance",
        "0 of 3 beyond chance",
        "0.10 0.90 mm",
        "1.05",
        "2.06",
    ):
        assert part in page.words.replace("\u00a0", " "), part
    for target in [a["href"] for t, a in page.elements if t == "a"]:
        assert target is not None
        assert target[0] == "#"
        assert target[1:] in page.ids


def card_of(page_words: str) -> str:
    """The verdict's card: what stands before the notes."""
    return page_words.split("What to know of this answer")[0].replace("\u00a0", " ")


def test_the_card_says_how_sure_what_else_and_what_next() -> None:
    diagnosis = make_diagnosis("effects")
    card = card_of(page_of(diagnosis=diagnosis).words)
    assert "glove stiffness: stiffness 1.774 (95 % interval 1.717 … 1.832) × 10⁻³ N·m/rad" in card
    assert "Ties glove stiffness or gravity: they fit equally well" in card
    assert "Runner-up" not in card, "gravity is tied"
    assert "hannes record --profile half_sine --option period=1.5 --object none" in card
    diagnosis["tied"] = []
    card = card_of(page_of(diagnosis=diagnosis).words)
    assert (
        "Runner-up gravity alone explains 41.0 % of the excess misfit (glove stiffness: 99.9 %)" in card
        and "Ties" not in card
    )
    many = {**diagnosis, "effects": [make_effect(f"effect_{k}") for k in range(6)]}
    card = card_of(page_of(diagnosis=many).words)
    assert "effect 3: stiffness" in card and "effect 4: stiffness" not in card and "2 more" in card


@pytest.mark.parametrize(
    ("verdict", "command", "then"),
    [
        ("effects", "hannes diagnose b --report r.html", "hannes diagnose b --report r.html --add"),
        ("effects", "hannes report b --out r.html", "hannes diagnose b --report r.html --add"),
        ("effects", "hannes diagnose b --add", "hannes run graph --model my_hand.yaml"),
        ("effects", "hannes diagnose b --add --out a.yaml", "hannes run graph --model a.yaml"),
        ("effects", "hannes diagnose b --add --rig r.py:R", None),
        ("added", "hannes add b --effect x --out=b.yaml", "hannes run graph --model b.yaml"),
        ("unknown", "hannes diagnose b", "hannes diagnose b --effect my_effect.py:MyEffect"),
        ("nothing", "hannes diagnose b", None),
        ("comparison", "hannes compare b --fitted --report r.html", "hannes diagnose b"),
        ("effects", "something else", None),
        ("effects", "hannes diagnose 'b", None),
    ],
)
def test_what_to_run_next(verdict: str, command: str, then: str | None) -> None:
    step = next_step(verdict, None, command)
    assert (step and step["command"]) == then


def test_what_explains_most_and_foretells_nothing_is_worth_a_look() -> None:
    told = {
        "unknown_kind": "not_foretold",
        "ranking": [{"names": ["gravity"], "explained": 0.1}, {"names": ["cogging"], "explained": 0.9}],
    }
    step = next_step("unknown", told, "hannes diagnose b --rig a.py:A --only cogging --greedy --jobs 1")
    assert step is not None and "cogging does to closures that were left out" in step["text"]
    assert step["command"] == "hannes add b --rig a.py:A --jobs 1 --effect cogging"


def test_ties_that_nothing_separates_give_no_command() -> None:
    diagnosis = make_diagnosis("effects")
    diagnosis["experiments"][0]["distance"] = 0.1
    told = next_step("unknown", {"unknown_kind": "no_repeats"}, "hannes diagnose b")
    assert (
        told is not None and told["text"].startswith("Record each motion five times") and not told["command"]
    )
    step = next_step("effects", diagnosis, "hannes diagnose b")
    assert step is not None and not step["command"] and "No experiment" in step["text"]


def test_notes_come_after_the_verdict_long_ones_folded() -> None:
    long = "a sentence that goes on " * 20
    diagnosis = make_diagnosis("effects") | {"notes": [long, *(f"note {k}" for k in range(9))]}
    page = page_of(comparison=make_comparison(), diagnosis=diagnosis)
    before = page.words.split("How the error falls")[0]
    assert "What to know of this answer a sentence that goes on" in before
    assert " ".join(long.split()) in before and "note 8" in before and "6 more" in before
    assert page.words.count("there is one condition only") == 1
    assert (
        sum(t == "details" for t, _ in page.elements[: page.elements.index(("section", {"id": "fall"}))]) == 2
    )


def test_models_are_told_apart_by_name() -> None:
    after = make_comparison(off=0.05) | {"model": {"name": "nominal", "sha256": "ef" * 32}}
    words = page_of(comparison=make_comparison(), after=after, diagnosis=make_diagnosis("effects")).words
    assert f"before, diagnosed nominal sha256 {'ab' * 32}" in words
    assert f"after nominal + glove_stiffness sha256 {'ef' * 32}" in words


def test_no_excess_is_not_shared_out() -> None:
    page = page_of(comparison=None, diagnosis=make_diagnosis("nothing"))
    assert "There is no excess to explain" in page.words
    assert "99.9" not in page.words


def test_an_effect_that_is_found_within_chance_has_its_share() -> None:
    diagnosis = make_diagnosis("effects")
    diagnosis["costs"] |= {"nominal_fitted": 0.7 * diagnosis["costs"]["critical"]}
    page = page_of(comparison=None, diagnosis=diagnosis)
    assert "There is no excess to explain" not in page.words
    assert "the effect that was found gains more than chance does" in page.words and "99.9" in page.words


def test_the_ranking_says_how_many_of_the_effects_are_shown() -> None:
    diagnosis = make_diagnosis("effects")
    assert "the others are folded" not in page_of(diagnosis=diagnosis).words
    diagnosis["ranking"] += [
        {"names": [f"effect_{k}"], "misfit": 1e4, "cost": 1e4, "explained": 0.0} for k in range(9)
    ]
    words = page_of(diagnosis=diagnosis).words
    assert "The 8 that explain most; the 3 others are folded below them." in words
    assert "The 3 others" in words


def test_repeatability_is_said_as_it_is_computed() -> None:
    words = page_of(diagnosis=make_diagnosis("effects")).words.replace("\u00a0", " ")
    assert "root mean square of the closures around their own mean (n − 1 in the denominator)" in words
    assert "another closure of the same kind" not in words


def test_experiments_that_separate_nothing_are_called_so() -> None:
    diagnosis = make_diagnosis("effects")
    diagnosis["experiments"][0]["distance"] = 0.1
    assert "None of those that were considered does" in page_of(diagnosis=diagnosis).words


def test_shared_effects_of_a_tie() -> None:
    diagnosis = make_diagnosis("effects")
    diagnosis["effects"].append(make_effect("gravity"))
    diagnosis["tied"] = [["glove_stiffness", "gravity"], ["glove_stiffness", "return_preload"]]
    assert (
        "The model lacks glove stiffness and one of these: gravity or return preload. The data cannot tell which."
        in page_of(diagnosis=diagnosis).words
    )


@pytest.mark.parametrize(
    "parts",
    [
        {"comparison": make_comparison()},
        {"comparison": None, "after": make_comparison()},
        {"comparison": make_comparison(closures=1)},
        {"diagnosis": make_diagnosis("unknown")},
        {"diagnosis": {"verdict": "effects"}},
        {"diagnosis": {"verdict": "<b>new"}},
        {"comparison": {"overall": None}},
    ],
    ids=[
        "comparison",
        "after only",
        "one closure",
        "diagnosis",
        "bare diagnosis",
        "other verdict",
        "bare comparison",
    ],
)
def test_missing_parts(parts: dict[str, Any]) -> None:
    page = page_of(**parts)
    assert "verdict" in page.ids
    assert not re.search(r"\bnan\b|\bNone\b(?! of)", page.words)


def test_one_closure_shows_dashes_and_errors_in_units() -> None:
    page = page_of(comparison=make_comparison(closures=1))
    assert "without repeated closures there is no scale" in page.words
    assert "1 closure of slow" in page.words
    assert "0.30 rad" in page.words.replace("\u00a0", " ")
    assert "× repeatability" not in page.words and "±2" not in page.words
    assert "0.300 rad error of encoder position" in page.words.replace("\u00a0", " ")


@pytest.mark.parametrize("held", [True, False], ids=["two conditions", "one"])
def test_where_nothing_was_repeated_the_error_falls_in_the_signals_units(held: bool) -> None:
    diagnosis = make_diagnosis("effects")
    for fall, rmse in zip(diagnosis["falls"], (0.5, 0.4, 0.25), strict=True):
        fall |= {"train": NAN, "held_out": NAN, "by_condition": {"slow": NAN} if held else {}}
        fall["signals"][0] |= {"rmse": rmse / 2, "repeatability": NAN, "ratio": NAN}
        fall["held_out_signals"] = {"encoder_position": rmse} if held else {}
    single = {"comparison": make_comparison(closures=1), "after": make_comparison(closures=1, off=0.1)}
    page = page_of(**single, diagnosis=diagnosis)
    words = page.words.replace("\u00a0", " ")
    where = "on conditions that were left out of the fit" if held else "of the fit"
    was, now = ("0.400", "0.250") if held else ("0.200", "0.125")
    assert f"{was} → {now} rad error of encoder position {where}; before: nominal, fitted" in words
    assert "No condition was repeated: there is no repeatability to hold the error against." in words
    assert "+ glove stiffness" in words and "× repeatability" not in words and "– →" not in words


def test_the_card_and_the_summary_tell_the_same_fall() -> None:
    """From the nominal model as it was given, where its fit is further off."""
    diagnosis = make_diagnosis("effects")
    for fall, error in zip(diagnosis["falls"], (2.0, 2.5, 0.95), strict=True):
        fall["held_out"] = error
    words = page_of(comparison=make_comparison(), diagnosis=diagnosis).words.replace("\u00a0", " ")
    assert (
        "2.00 → 0.95 error on held-out closures, in multiples of the repeatability; before: nominal, as given"
        in words
    )
    falls = [Fall(f["added"], f["train"], f["held_out"], {}, ()) for f in diagnosis["falls"]]
    assert fall_sentence(falls).endswith(
        "falls from 2.00 (nominal, as given) to 0.95 times the repeatability."
    )


def test_where_nothing_was_repeated_the_fall_begins_with_the_nearer_nominal_model() -> None:
    """As given 3.4 on what was left out, fitted 5.6, with an effect 1.9: not even halved."""
    diagnosis = make_diagnosis("effects")
    for fall, rmse in zip(diagnosis["falls"], (3.4, 5.6, 1.9), strict=True):
        fall |= {"train": NAN, "held_out": NAN, "by_condition": {"slow": NAN}}
        fall["held_out_signals"] = {"encoder_position": rmse}
    words = page_of(comparison=make_comparison(closures=1), diagnosis=diagnosis).words.replace("\u00a0", " ")
    assert "3.40 → 1.90 rad error of encoder position" in words and "before: nominal, as given" in words
    signals = (SignalError("slow", "encoder_position", "rad", 0.1, NAN, NAN),)
    falls = [Fall(f["added"], NAN, NAN, {}, signals, f["held_out_signals"]) for f in diagnosis["falls"]]
    assert "encoder_position from 3.4 to 1.9 rad" in fall_sentence(falls)
    assert runner_up({"excess": True, "first": [], "rest": []}, diagnosis) is None


def test_an_effect_that_explains_most_and_foretells_nothing_is_named_in_a_note() -> None:
    """Of a start and of laps the one does not foretell the other: no effect joins, whatever it explains."""
    rank = Rank(("cogging",), 10.0, 14.0, 0.91)

    def told(
        explained: float, names: tuple[str, ...] = (), repeated: bool = True, taken_back: tuple[str, ...] = ()
    ) -> tuple[str, ...]:
        features = SimpleNamespace(repeated=repeated)
        choice = SimpleNamespace(
            ranking=(Rank(("gravity",), 90.0, 94.0, 0.0), replace(rank, explained=explained)),
            best=SimpleNamespace(names=names),
            search=SimpleNamespace(problem=SimpleNamespace(features=features)),
            taken_back=taken_back,
        )
        return unforetold(choice)

    (note,) = told(0.91)
    assert note.startswith("cogging alone explains 91 %") and "hannes add --effect cogging" in note
    assert not told(0.3) and not told(0.91, ("cogging",)) and not told(0.91, repeated=False)
    assert not told(0.91, taken_back=("cogging",)), "there it foretold better"


def test_overlays_of_the_same_condition_keep_their_counterparts() -> None:
    two = make_comparison()
    two["overlays"] *= 2
    after = make_comparison(off=0.05)
    after["overlays"] *= 2
    page = page_of(comparison=two, after=after)
    pairs = [
        (a["data-overlay"], a["data-after"])
        for t, a in page.elements
        if t == "figure" and "data-overlay" in a
    ]
    assert pairs == [("0", "0"), ("1", "1")]


HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)> {{ 7*7 }} $x$ \u2028"


def hostile(data: Any) -> Any:
    """The same data with every text made hostile, phases and variables too."""
    if isinstance(data, dict):
        # names of variables and parameters are keys
        return {
            (HOSTILE + k if isinstance(v, dict) and {"value", "centres"} & set(v) else k): hostile(v)
            for k, v in data.items()
        }
    if isinstance(data, list):
        return [hostile(v) for v in data]
    return HOSTILE + data if isinstance(data, str) else data


def test_everything_from_the_data_is_escaped(tmp_path: Path) -> None:
    clean = page_of(
        comparison=make_comparison(), after=make_comparison(), diagnosis=make_diagnosis("effects")
    )
    bad = {
        "comparison": hostile(make_comparison()),
        "after": hostile(make_comparison()),
        "diagnosis": {**hostile(make_diagnosis("effects")), "verdict": "effects"},
    }
    page = page_of(**bad, title=HOSTILE, command=HOSTILE)
    assert len(page.scripts) == len(clean.scripts) == 3
    assert not [t for t, _ in page.elements if t in ("img", "iframe", "object", "link", "base", "form")]
    assert not [a for _, a in page.elements for name in a if name.startswith("on")]
    assert "49" not in page.data["title"]
    assert page.data["title"] == HOSTILE
    for _, attrs in page.elements:
        assert "alert" not in (attrs.get("style") or "") + (attrs.get("class") or "") + (
            attrs.get("id") or ""
        )
    write_picture(tmp_path / "hostile.png", **bad, title=HOSTILE)


def test_nothing_is_requested_and_only_our_scripts_run() -> None:
    source = render_report(
        comparison=make_comparison(),
        after=make_comparison(),
        diagnosis=make_diagnosis("effects"),
        title="Test",
        command="x",
    )
    page = Page(source)
    assert not [a for _, a in page.elements if {"src", "srcset", "data", "poster", "action"} & set(a)]
    assert all((a.get("href") or "#").startswith("#") for _, a in page.elements)
    assert not re.search(r"url\(|@import|@font-face", page.style)
    code = "".join(body for _, body in page.scripts)
    assert not re.search(
        r"fetch\(|XMLHttpRequest|WebSocket|EventSource|importScripts|sendBeacon|\bimport\s*\(", code
    )
    # Addresses stand in comments and licences only, never in an attribute or a style
    for found in re.finditer(r"https?://", source):
        before = source[max(0, found.start() - 12) : found.start()]
        assert not re.search(r"(src|href|url\(|@import)\s*=?\s*[\"']?$", before)
    policy = next(a["content"] for t, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert "default-src 'none'" in policy
    for attrs, body in page.scripts:
        if attrs.get("type") != "application/json":
            digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
            assert f"'sha256-{digest}'" in policy


def test_the_data_are_inside_as_json() -> None:
    comparison, diagnosis = make_comparison(closures=1), make_diagnosis("effects")
    page = page_of(comparison=comparison, diagnosis=diagnosis)
    assert page.data["comparison"]["overall"] is None
    assert page.data["comparison"]["overlays"] == comparison["overlays"]
    assert page.data["diagnosis"]["effects"] == diagnosis["effects"]
    assert page.data["after"] is None
    assert page.data["versions"]["python"]
    assert "<" not in embedded_json({"a": HOSTILE})
    odd = {"a": HOSTILE, "b": [math.inf, NAN, 1.0]}
    assert json.loads(embedded_json(odd)) == {"a": HOSTILE, "b": [None, None, 1.0]}


def test_the_same_data_give_the_same_page_and_it_is_small(tmp_path: Path) -> None:
    parts: dict[str, Any] = {
        "comparison": make_comparison(),
        "after": make_comparison(off=0.05),
        "diagnosis": make_diagnosis("effects"),
        "title": "Test",
        "command": "x",
    }
    first = write_report(tmp_path / "deep" / "a.html", **parts)
    second = write_report(tmp_path / "b.html", **parts)
    assert first.read_bytes() == second.read_bytes()
    assert first.stat().st_size < 1_500_000


def test_a_large_data_set_stays_below_the_limit() -> None:
    def large(off: float) -> dict[str, Any]:
        out = make_comparison(off=off)
        n = 160
        long = {
            "phase": ["void"] * n,
            **{
                k: [math.sin(0.1 * i) for i in range(n)]
                for k in ("measured", "low", "high", "model", "reference")
            },
            "time": [0.01 * i for i in range(n)],
        }
        out["overlays"] = [{**out["overlays"][0], **long, "condition": f"c{i}"} for i in range(18)]
        return out

    source = render_report(comparison=large(0.3), after=large(0.1), diagnosis=make_diagnosis("effects"))
    assert len(source.encode()) < 1_500_000


def test_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(HannesError, match="nothing to report"):
        render_report(comparison=None)
    with pytest.raises(HannesError, match="nothing to draw"):
        write_picture(tmp_path / "x.png", comparison=None)
    with pytest.raises(HannesError, match=r"must end in \.png"):
        write_picture(tmp_path / "x.bmp", comparison=make_comparison())
    (tmp_path / "file").write_text("x")
    with pytest.raises(HannesError, match="cannot be written"):
        write_report(tmp_path / "file" / "a.html", comparison=make_comparison())
    with pytest.raises(HannesError, match="cannot be written"):
        write_picture(tmp_path / "file" / "a.png", comparison=make_comparison())


@pytest.mark.parametrize(
    "parts",
    [
        {
            "comparison": make_comparison(),
            "after": make_comparison(off=0.05),
            "diagnosis": make_diagnosis("effects"),
        },
        {"comparison": make_comparison(closures=1)},
        {"comparison": None, "diagnosis": make_diagnosis("nothing")},
        {"comparison": {"overall": None}},
    ],
    ids=["whole", "one closure", "diagnosis", "bare"],
)
def test_picture(parts: dict[str, Any], tmp_path: Path) -> None:
    made = write_picture(tmp_path / "a" / "picture.png", **parts)
    assert made.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert made.stat().st_size > 5_000


def test_picture_as_svg_is_the_same_every_time(tmp_path: Path) -> None:
    first, second = (write_picture(tmp_path / f"{k}.svg", comparison=make_comparison()) for k in range(2))
    assert first.read_bytes() == second.read_bytes()
    assert b"<svg" in first.read_bytes()


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (number(0.00295), "0.00295"),
        (number(12.3456), "12.3"),
        (number(1.2345e-5), "1.23 × 10⁻⁵"),
        (number(NAN), "–"),
        (number(None), "–"),
        (number(0.0), "0"),
        (number(-0.5), "−0.500"),
        (number(True), "–"),
        (number(123456.7), "1.23 × 10⁵"),
        (ratio(0.912), "0.91"),
        (ratio(57.58), "57.6"),
        (ratio(1234.0), "1234"),
        (ratio(NAN), "–"),
        (percent(0.9992), "> 99\u00a0%"),
        (percent(0.9992, 1), "99.9\u00a0%"),
        (percent(1.0), "100\u00a0%"),
        (percent(0.0001), "< 1\u00a0%"),
        (percent(0.0), "0\u00a0%"),
        (signed_percent(-8.25), "−8.2\u00a0%"),
        (signed_percent(3.0), "+3.0\u00a0%"),
        (relative_error(MetricRow("a", "b", "A", 2.0, 0.1, 1.5, 25.0).to_dict()), "+25.0\u00a0%"),
        (
            relative_error(MetricRow("a", "b", "A", 0.02, 0.001, 1.18, -5800.0).to_dict()),
            "59\u00a0× too large",
        ),
        (relative_error(MetricRow("a", "b", "A", 0.02, 0.03, 1.18, -5800.0).to_dict()), "–"),
        (signed_percent(0.01), "0.0\u00a0%"),
        (plus_minus(0.26739, 0.00192), "0.2674 ± 0.0019"),
        (plus_minus(0.877, 2e-16), "0.877 ± 0"),
        (plus_minus(5.0, NAN), "5.00"),
        (unit("kg.m2"), "kg·m²"),
        (unit("N.m/rad3"), "N·m/rad³"),
        (unit("1"), ""),
    ],
)
def test_numbers(made: str, text: str) -> None:
    assert made == text


def test_intervals_share_a_power_of_ten() -> None:
    assert interval(0.0017743, 0.0017166, 0.001832, "N.m/rad") == {
        "value": "1.774",
        "low": "1.717",
        "high": "1.832",
        "unit": "10⁻³ N·m/rad",
    }
    assert interval(1.8, None, NAN, "s") == {"value": "1.800", "low": "–", "high": "–", "unit": "s"}
    assert interval(NAN, 0.0, 1.0, "s")["value"] == "–"


def test_the_figures_of_the_heading_end_within_the_picture() -> None:
    """Three errors in units of their own, of a recording without repeats, are long."""
    figure = Figure(figsize=(14.0, 8.0))
    long = {"was": "0.0871", "value": "0.0630 rad", "label": "error of encoder position on conditions " * 3}
    _heading(figure, {"kind": "unknown", "label": "", "headline": "", "figures": [long] * 3}, "", 8.0)
    assert any("0.0630" in text.get_text() for text in figure.texts)
    assert max(text.get_window_extent().x1 for text in figure.texts) <= figure.bbox.x1


def test_a_picture_shows_the_conditions_that_are_missed_most() -> None:
    """Six conditions of two signals, of which the last is missed most, and of another signal the third."""
    names = [f"v{k}" for k in range(6)]

    def overlay(condition: str, signal: str, size: float, off: float) -> dict[str, Any]:
        measured = [0.0, size, None, 0.0]
        return {
            "condition": condition,
            "signal": signal,
            "measured": measured,
            "model": [off, size + off, 0.0, off],
        }

    overlays = [overlay(name, "encoder_position", 10.0, 0.01 * k) for k, name in enumerate(names)]
    overlays += [overlay(name, "motor_current", 0.5, 0.2 if name == "v0" else 0.0) for name in names]
    assert most_missed(overlays, names) == ["v0", "v3", "v4", "v5"]
    assert (
        most_missed(overlays[:3], names[:3]) == names[:3]
        and len(most_missed(overlays, names)) == MAX_CONDITIONS
    )
