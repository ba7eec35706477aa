"""How good the stiffness classifier is: the targets beside what was measured, the thesis' method in the same run.

    python bench/stiffness.py                  everything, about a quarter of an hour on one core
    python bench/stiffness.py --closures 13 --hands 13   a third of the closures, without the ablations
    python bench/stiffness.py --seed 4711 --ablations 0   other hands: how much of it is the draw
    python bench/stiffness.py --write          also put the tables into docs/stiffness.md, the pictures beside it

Every seed here is another than those of the training. Data sets are kept in --work, so that a second run goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from hannes_description.model import Model
from hannes_sim.measurement import Sensors
from hannes_sim.objects import GraspObject
from hannes_stiffness.classifier import StiffnessClassifier
from hannes_stiffness.dataset import (
    VARIETIES,
    Closure,
    Dataset,
    bench_scenes,
    draw_scenes,
    hand_of,
    make_dataset,
)
from hannes_stiffness.evaluation import Answered, answer, scores_of
from hannes_stiffness.features import FeatureStream
from hannes_stiffness.models import TreeSettings
from hannes_stiffness.scoring import HOPS, score_closures
from hannes_stiffness.training import train

SEED = 2026
PENTAGONS = {
    "rigid pentagon": GraspObject("pentagon", 0.065, 40e3, 20.0),
    "soft pentagon": GraspObject("pentagon", 0.065, 400.0, 2.0),
}
CALIBRATED, NOMINAL, REDUCED, UNSEEN = "thesis_hand", "nominal_mujoco", "nominal", "thesis_hand_2342"
"""Models: calibrated to the thesis' figures, before it, the reduced plant; with the other motor (in no training)."""
FEW = 13
"""Closures on each object, another hand each, where the models are not the one that the targets are of."""
DOCS = Path(__file__).resolve().parents[1] / "docs"
# Signed, otherwise like the thesis' log: what rectifying costs.
SIGNED = Sensors(current_rectified=False)


def kept(work: Path, what: str, *models: Model) -> Path:
    """Folder of a data set; a model that has changed has another one."""
    return work / "_".join([what, *(f"{model.name}_{model.sha256[:8]}" for model in models)])


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"


def milliseconds(value: float | None) -> str:
    return "never" if value is None else f"{1e3 * value:.0f} ms"


def cost_of_an_answer(classifier: StiffnessClassifier, closure: Closure) -> tuple[float, float]:
    """Median and 99th percentile of the time from a sample to its answer, s, as the node computes it."""
    stream, times = FeatureStream(classifier.spec), []
    rows = zip(closure.time, closure.current, closure.reference, closure.encoder, strict=True)
    for k, row in enumerate([*rows] * 10):
        values = (float(row[0]) + 60.0 * (k // len(closure.time)), *map(float, row[1:]))
        start = time.perf_counter()
        sample = stream.push(*values)
        if sample is not None:
            answers = classifier.answer([sample.values], [sample.void])
            answers.sure(classifier.least)
            times.append(time.perf_counter() - start)
    return float(np.median(times)), float(np.quantile(times, 0.99))


def loading_time() -> float:
    """Time to load the default classifier, s, once onnxruntime itself is there."""
    StiffnessClassifier.load()
    start = time.perf_counter()
    StiffnessClassifier.load()
    return time.perf_counter() - start


def over_hands(answered: Sequence[Answered]) -> tuple[tuple[float, float], tuple[float, float]]:
    """95 % intervals of window F1 (hop 150 ms) and of the part of the grasps answered rightly, hands drawn again.

    Closures of one hand share its mechanics: the hands, not the closures, are the independent draws.
    """
    hands = sorted({a.closure.scene.hand for a in answered})
    windows, right = [], []
    for hand in hands:
        rows = [a for a in answered if a.closure.scene.hand == hand]
        windows.append(
            score_closures(
                (("", a.time, a.truth, a.classes) for a in rows), HOPS["overlap_50ms"]
            ).pooled.confusion
        )
        right.append((sum(a.kind == a.grasp for a in rows), len(rows)))
    confusions, counts = np.array(windows), np.array(right)
    rng = np.random.default_rng(SEED)
    f1, grasps = [], []
    for _ in range(1000):
        drawn = rng.integers(len(hands), size=len(hands))
        c = confusions[drawn].sum(axis=0)
        of = c.sum(axis=0) + c.sum(axis=1)
        f1.append(float(np.mean(2.0 * np.diag(c)[of > 0] / of[of > 0])))
        grasps.append(float(counts[drawn, 0].sum() / counts[drawn, 1].sum()))
    low, high = (tuple(np.quantile(x, (0.025, 0.975))) for x in (f1, grasps))
    return low, high


def errors(wide: Sequence[Answered], ten: Sequence[Answered], model: Model, seed: int) -> tuple[str, str]:
    """Where the wrong answers are, of the samples on which no rule decides: objects of any stiffness by stiffness and
    by time since the contact; the ten objects by hidden effect."""

    def samples(answered: Sequence[Answered]) -> np.ndarray:
        rows = []
        for k, a in enumerate(answered):
            grasp = a.closure.scene.grasp
            open_ = ~a.void
            rows.append(
                np.column_stack(
                    [
                        np.full(open_.sum(), k),
                        np.full(open_.sum(), np.nan if grasp is None else grasp.stiffness),
                        (a.time - a.closure.touched)[open_],
                        a.truth[open_],
                        a.classes[open_],
                    ]
                )
            )
        return np.concatenate(rows)

    def line(name: str, rows: np.ndarray, everything: np.ndarray) -> list[str]:
        wrong = rows[rows[:, 3] != rows[:, 4]]
        of = max(1, int(np.sum(everything[:, 3] != everything[:, 4])))
        pairs = [
            f"{int(np.sum((wrong[:, 3] == a) & (wrong[:, 4] == b)))}"
            for a, b in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
        ]
        return [name, str(len(rows)), percent(len(wrong) / len(rows) if len(rows) else None),
                percent(len(wrong) / of), *pairs]  # fmt: skip

    head = ("samples of the wide set", "count", "wrong", "share of all errors", "void as rigid", "void as soft",
            "rigid as void", "rigid as soft", "soft as void", "soft as rigid")  # fmt: skip
    x = samples(wide)
    rows = [line("all", x, x), line("closures on nothing", x[np.isnan(x[:, 1])], x)]
    edges = (100.0, 300.0, 1e3, 3e3, 6e3, 12e3, 18.4e3, 28e3, 40e3, 100.1e3)
    rows += [
        line(f"{low / 1e3:g} to {high / 1e3:g} kN/m", x[(x[:, 1] >= low) & (x[:, 1] < high)], x)
        for low, high in pairwise(edges)
    ]
    times = (-9.0, 0.0, 0.1, 0.2, 0.3, 0.5, 0.8, 1.5, 9.0)
    for low, high in pairwise(times):
        here = x[(x[:, 2] >= low) & (x[:, 2] < high)]
        name = "before the contact" if high == 0.0 else f"{low:g} to {high:g} s after the contact"
        rows.append(line(name if high < 9.0 else f"later than {low:g} s", here, x))
    by_sample = table(head, rows)

    own = [e.name for e in model.effects]
    names: dict[int, list[str]] = {}
    for a in ten:
        hand = a.closure.scene.hand
        if hand not in names:
            hidden = hand_of(model, hand, seed, varied=True).effects
            strengths = {e.name: dict(e.values) for e in model.effects}
            names[hand] = [e.name for e in hidden if e.name not in own or dict(e.values) != strengths[e.name]]
    rows = []
    for effect in ["none", *sorted({n for some in names.values() for n in some})]:
        hands = {h for h, some in names.items() if (effect in some or (effect == "none" and not some))}
        closures = [a for a in ten if a.closure.scene.hand in hands]
        y = samples(closures)
        rows.append(
            [effect.replace("_", " "), str(len(hands)), percent(float(np.mean(y[:, 3] != y[:, 4]))),
             f"{sum(a.kind != a.grasp for a in closures)} of {len(closures)}"]
        )  # fmt: skip
    rows.sort(key=lambda row: -float(row[2].split()[0]))
    return by_sample, table(("hidden effect", "hands", "samples wrong", "grasps wrong"), rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--closures", type=int, default=39, help="closures on each of the ten objects")
    parser.add_argument("--hands", type=int, default=39, help="hands of the population")
    parser.add_argument(
        "--seed", type=int, default=SEED, help="of hands, effects, noise; no seed of a training"
    )
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "hannes_bench_stiffness")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--ablations", type=int, default=800, help="closures to train each ablation on; 0: none"
    )
    parser.add_argument("--write", action="store_true", help="put tables and pictures into docs")
    parser.add_argument("--json", type=Path, help="write all scores to this file")
    given = parser.parse_args()
    given.work /= f"seed_{given.seed}"
    ablations = given.ablations if given.closures >= 39 else 0

    models = {name: Model.load(name) for name in (CALIBRATED, NOMINAL, REDUCED, UNSEEN)}

    def test(model: str, closures: int) -> Dataset:
        scenes = bench_scenes(given.hands, closures, model=models[model].name)
        folder = kept(given.work, f"ten_{given.hands}_{closures}", models[model])
        return make_dataset(scenes, models[model], seed=given.seed, jobs=given.jobs, folder=folder)

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    window, thesis = StiffnessClassifier.load("window"), StiffnessClassifier.load("baseline")
    results, answered = {}, []
    for model, closures in (
        (CALIBRATED, given.closures), (NOMINAL, FEW), (UNSEEN, FEW), (REDUCED, FEW)
    ):  # fmt: skip
        say(f"Ten objects, {model}.")
        ten = test(model, closures).closures
        results[model] = scores_of(answer(window, ten))
        results[f"{model}, thesis' method"] = scores_of(answer(thesis, ten))
        if model == CALIBRATED:
            answered = answer(window, ten)
    say("Pentagons.")
    pentagons: list[Closure] = []
    for model in (CALIBRATED, NOMINAL):
        scenes = bench_scenes(1, 5, model=models[model].name, varied=False, objects=PENTAGONS)
        folder = kept(given.work, "pentagons", models[model])
        pentagons += make_dataset(
            scenes, models[model], seed=given.seed, jobs=given.jobs, folder=folder
        ).closures
    results["pentagons"] = scores_of(answer(window, pentagons))
    results["pentagons, thesis' method"] = scores_of(answer(thesis, pentagons))
    say("Unseen objects of any stiffness.")
    wide = make_dataset(
        draw_scenes(300, given.seed, hands=100, models=[models[CALIBRATED].name], variety="wide"),
        models[CALIBRATED], seed=given.seed, jobs=given.jobs, folder=kept(given.work, "wide", models[CALIBRATED]),
    ).closures  # fmt: skip
    answered_wide = answer(window, wide)
    results["wide"] = scores_of(answered_wide)
    by_sample, by_effect = errors(answered_wide, answered, models[CALIBRATED], given.seed)
    (f1_low, f1_high), (grasps_low, grasps_high) = over_hands(answered)
    median, slowest = cost_of_an_answer(window, answered[0].closure)
    loading = loading_time()

    r, t = results[CALIBRATED], results[f"{CALIBRATED}, thesis' method"]
    p, q = results["pentagons"], results["pentagons, thesis' method"]
    stiff = r["stiffness"]

    def f1(scores: dict, part: str) -> float:
        return scores[part]["pooled"]["f1"]

    def row(what: str, target: str, ours: str, theirs: str, met: bool) -> list[str]:
        return [what, target, ours, theirs, "yes" if met else "**no**"]

    late = r["latency"]["pooled"]
    targets = table(
        ("test", "target", "measured", "thesis' method, same run", "met"),
        [
            row("R17: pentagons, nominal hand, window F1 (hop 150 ms)", "100 %", percent(f1(p, "overlap_50ms")),
                percent(f1(q, "overlap_50ms")), f1(p, "overlap_50ms") == 1.0),
            row("R17, hop 50 ms", "100 %", percent(f1(p, "hop_50ms")), percent(f1(q, "hop_50ms")),
                f1(p, "hop_50ms") == 1.0),
            row("ten objects, pooled window F1 (hop 150 ms)", ">= 95 %",
                f"{percent(f1(r, 'overlap_50ms'))} ({100 * f1_low:.1f} to {100 * f1_high:.1f})",
                percent(f1(t, "overlap_50ms")), f1(r, "overlap_50ms") >= 0.95),
            row("the same, hop 50 ms", ">= 95 %", percent(f1(r, "hop_50ms")), percent(f1(t, "hop_50ms")),
                f1(r, "hop_50ms") >= 0.95),
            row("the same, truth by the void current alone (hop 150 ms)", ">= 95 %",
                percent(r["overlap_50ms"]["by_rule_alone"]["f1"]), percent(t["overlap_50ms"]["by_rule_alone"]["f1"]),
                r["overlap_50ms"]["by_rule_alone"]["f1"] >= 0.95),
            row("ten objects, grasps answered rightly", ">= 98 %",
                f"{percent(r['grasps']['pooled']['accuracy'])} ({100 * grasps_low:.1f} to {100 * grasps_high:.1f})",
                percent(t["grasps"]["pooled"]["accuracy"]), r["grasps"]["pooled"]["accuracy"] >= 0.98),
            row("latency from the first contact, median", "<= 100 ms", milliseconds(late["from_contact_median_s"]),
                milliseconds(t["latency"]["pooled"]["from_contact_median_s"]),
                (late["from_contact_median_s"] or 9.0) <= 0.1),
            row("latency from a grip of 2 N, median", "<= 100 ms", milliseconds(late["from_grip_median_s"]),
                milliseconds(t["latency"]["pooled"]["from_grip_median_s"]),
                (late["from_grip_median_s"] or 9.0) <= 0.1),
            row("latency from the first sample above 0.3 A with contact, median", "<= 100 ms",
                milliseconds(late["from_void_current_median_s"]),
                milliseconds(t["latency"]["pooled"]["from_void_current_median_s"]),
                (late["from_void_current_median_s"] if late["from_void_current_median_s"] is not None else 9.0) <= 0.1),
            row("stiffness of a grasp within a factor 1.5", ">= 90 %", percent(stiff["grasps"]["within_factor"]),
                "none", (stiff["grasps"]["within_factor"] or 0.0) >= 0.9),
            row("interval holds the truth, per sample", "90 %", percent(stiff["samples"]["covered"]), "none",
                (stiff["samples"]["covered"] or 0.0) >= 0.895),
            row("interval holds the truth, unseen objects of any stiffness, per sample", "90 %",
                percent(results["wide"]["stiffness"]["samples"]["covered"]), "none",
                (results["wide"]["stiffness"]["samples"]["covered"] or 0.0) >= 0.895),
            row("one answer: median (99th percentile)", "<= 1 ms",
                f"{1e3 * median:.2f} ms ({1e3 * slowest:.2f} ms)", "", slowest <= 1e-3),
            row("loading the classifier", "< 100 ms", f"{1e3 * loading:.0f} ms", "", loading < 0.1),
        ],
    )  # fmt: skip
    targets += (
        "\n\nFrom the first contact to a grip of 2 N, median: "
        f"{milliseconds(late['contact_to_grip_median_s'])}."
    )
    made_with = ", ".join(f"{name} {model.sha256[:8]}" for name, model in models.items())
    targets += (
        " In brackets: 95 % interval over the hands (bootstrap). Models: "
        f"{made_with}; classifier {window.manifest['onnx']['sha256'][:8]}, baseline "
        f"{thesis.manifest['onnx']['sha256'][:8]}."
    )
    hidden = "; ".join(f"{name}: {s['hidden']}" for name, s in r["grasps"]["objects"].items() if s["hidden"])
    objects = table(
        ("object", "window F1, hop 150 ms", "thesis' method", "grasps right", "thesis' method", "median latency",
         "from 0.3 A"),
        [
            [name, percent(r["overlap_50ms"]["objects"][name]["f1"]), percent(t["overlap_50ms"]["objects"][name]["f1"]),
             percent(g["accuracy"]), percent(t["grasps"]["objects"][name]["accuracy"]),
             milliseconds(r["latency"]["objects"].get(name, {}).get("from_contact_median_s")),
             milliseconds(r["latency"]["objects"].get(name, {}).get("from_void_current_median_s"))]
            for name, g in r["grasps"]["objects"].items()
        ],
    )  # fmt: skip
    objects += (
        f"\n\nGrasps whose object never raised the current above 0.3 A, so that void is right: {hidden or 0}."
    )
    where = table(
        ("data", "window F1, hop 150 ms", "thesis' method", "grasps right", "not sure", "right when sure",
         "calibration error", "stiffness within 1.5", "median factor", "interval holds, per sample"),
        [
            [title, percent(f1(results[name], "overlap_50ms")),
             percent(f1(results[beside], "overlap_50ms")) if beside in results else "-",
             percent(results[name]["grasps"]["pooled"]["accuracy"]), percent(results[name]["not_sure"]["part"]),
             percent(results[name]["not_sure"]["right_when_sure"]),
             str(results[name]["reliability"]["expected_calibration_error"]),
             percent(results[name]["stiffness"]["grasps"]["within_factor"]),
             str(results[name]["stiffness"]["grasps"]["median_factor"]),
             percent(results[name]["stiffness"]["samples"]["covered"])]
            for title, name in (
                ("ten objects, calibrated hand", CALIBRATED),
                ("ten objects, nominal hand, multi-body", NOMINAL),
                ("ten objects, calibrated hand with the other motor (no training has it)", UNSEEN),
                ("ten objects, nominal hand, reduced plant", REDUCED),
                ("unseen objects, 0.1 to 100 kN/m, all profiles, calibrated hand", "wide"),
            )
            for beside in (f"{name}, thesis' method",)
        ],
    )  # fmt: skip
    decades = table(
        ("stiffness", "grasps", "within 1.5", "median factor", "interval holds", "interval, factor either way"),
        [
            [name, str(s["count"]), percent(s["within_factor"]), str(s["median_factor"]), percent(s["covered"]),
             str(s["interval_factor"])]
            for name, s in results["wide"]["stiffness"]["by_stiffness"].items() if s["count"]
        ],
    )  # fmt: skip
    validated = window.manifest["scores"]["cross_validation"]
    methods = table(
        ("method", "no group of two folds", "log loss", "samples right", "window F1, hop 150 ms"),
        [
            [scores["title"], grouping, f"{scores[grouping]['log_loss']:.3f}", percent(scores[grouping]["right"]),
             percent(scores[grouping]["overlap_50ms"]["f1"])]
            for scores in validated.values() for grouping in scores if isinstance(scores[grouping], dict)
        ],
    ) + f"\n\nTaken: {window.manifest['method']}, {window.manifest['onnx']['bytes'] / 1e3:.0f} kB."  # fmt: skip
    parts = {"targets": targets, "objects": objects, "where": where, "stiffness": decades, "methods": methods,
             "errors": by_sample, "effects": by_effect}  # fmt: skip
    if ablations:
        parts["ablations"] = ablation_table(given, models, ablations, results, say)
    for name, text in parts.items():
        print(f"\n{name}\n{text}")
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if given.write:
        from hannes_stiffness.pictures import draw

        for path in draw(answered, r, DOCS / "stiffness"):
            say(f"Picture: {path}")
        write(DOCS / "stiffness.md", parts)
    return 0


def ablation_table(given, models, closures, results, say) -> str:  # type: ignore[no-untyped-def]
    """Each one trained on as many closures, tested on the ten objects by the calibrated hand.

    The logs keep the sign; "rectified" takes it away after the averaging of the logger.
    """
    names = [models[name].name for name in (CALIBRATED, NOMINAL, CALIBRATED, REDUCED)]

    def data(variety: str) -> Dataset:
        varied = variety == "wide"
        scenes = draw_scenes(
            closures, given.seed + 1, hands=closures // 2 if varied else 1, models=names, variety=variety,
            objects=closures // 2 if varied else None,
        )  # fmt: skip
        used = [models[name] for name in (CALIBRATED, NOMINAL, REDUCED)]
        folder = kept(given.work, f"train_{variety}_{closures}", *used)
        return make_dataset(
            scenes, *used, seed=given.seed + 1, jobs=given.jobs, sensors=SIGNED, folder=folder
        )

    say("Data sets of the ablations.")
    wide, two = data("wide"), data("two")
    without = [c for c in wide.closures if c.scene.model != models[CALIBRATED].name]
    ten = make_dataset(
        bench_scenes(given.hands, 2 * FEW, model=models[CALIBRATED].name),
        models[CALIBRATED], seed=given.seed, jobs=given.jobs, sensors=SIGNED,
        folder=kept(given.work, f"ten_signed_{given.hands}", models[CALIBRATED]),
    ).closures  # fmt: skip
    low, high = VARIETIES["narrow"].stiffness
    clear = [
        c for c in wide.closures
        if c.scene.grasp is None or c.scene.grasp.stiffness <= low[1] or c.scene.grasp.stiffness >= high[0]
    ]  # fmt: skip
    rows = []
    for title, used, method, current, void_current in (
        ("windows, randomised, rectified", wide, "forest", "rectified", 0.3),
        ("single samples instead of windows", wide, "thesis", "rectified", 0.3),
        ("two stiffnesses, hands as they are, instead of randomised", two, "forest", "rectified", 0.3),
        ("single samples and two stiffnesses (the thesis)", two, "thesis", "rectified", 0.3),
        ("signed instead of rectified current", wide, "forest", "signed", 0.3),
        (
            f"clearly soft or rigid objects only ({len(clear)} closures)",
            Dataset(tuple(clear), wide.manifest),
            "forest",
            "rectified",
            0.3,
        ),
        ("truth by contact alone, no rule of 0.3 A", wide, "forest", "rectified", 0.0),
        (
            f"without the calibrated hand ({len(without)} closures)",
            Dataset(tuple(without), wide.manifest),
            "forest",
            "rectified",
            0.3,
        ),
    ):
        say(f"Ablation: {title}.")
        path = train(
            used, given.work / "ablation.onnx", seed=given.seed, method=method, current=current,
            void_current=void_current, settings=TreeSettings(folds=3),
        )  # fmt: skip
        scores = scores_of(answer(StiffnessClassifier.load(path), ten))
        results[f"ablation: {title}"] = scores
        late = scores["latency"]["pooled"]
        rows.append(
            [title, percent(scores["overlap_50ms"]["pooled"]["f1"]), percent(scores["hop_50ms"]["pooled"]["f1"]),
             percent(scores["grasps"]["pooled"]["accuracy"]), milliseconds(late["from_contact_median_s"]),
             milliseconds(late["from_grip_median_s"]), percent(scores["stiffness"]["grasps"].get("within_factor"))]
        )  # fmt: skip
    head = ("trained on", "window F1, hop 150 ms", "hop 50 ms", "grasps right", "latency from contact", "from 2 N",
            "N/m within 1.5")  # fmt: skip
    return table(head, rows) + (
        f"\n\nBagged trees, trained on {closures} closures where it does not say otherwise; {len(ten)} test "
        "closures on the calibrated hand."
    )


def write(path: Path, parts: dict[str, str]) -> None:
    """Replace what stands between the markers of each part."""
    text = path.read_text(encoding="utf-8")
    for name, part in parts.items():
        begin, end = f"<!-- {name}: bench/stiffness.py -->", f"<!-- end of {name} -->"
        if begin in text and end in text:
            head, rest = text.split(begin, 1)
            text = f"{head}{begin}\n{part}\n{end}{rest.split(end, 1)[1]}"
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
