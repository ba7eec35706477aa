"""What learns: the thesis' bagged trees on single samples, and models on windows, compared by grouped cross-validation.

Bagging: every tree sees a bootstrap sample of the data and all features; the probabilities of the trees' leaves are
averaged (Breiman, Bagging predictors, Machine Learning 24, 1996). Boosting: Friedman, Stochastic gradient boosting,
CSDA 38, 2002. Calibration: a multinomial regression on the logarithms of held-out probabilities (Platt 1999, in its
form for several classes: Kull et al., NeurIPS 2019). Interval of the stiffness: split conformal prediction on held-
out residuals over their expected size (Lei et al., JASA 113, 2018).

scikit-learn is imported at its first use.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES
from numpy.typing import NDArray

from .features import SINGLE_SAMPLE, WINDOW

GROUPINGS = ("closures", "objects", "hands")
"""What is never split between training and validation."""


@dataclass(frozen=True)
class TreeSettings:
    """Settings of the bagged trees.

    trees     how many (30, the usual size of such a bag)
    leaves    most leaves of one tree; bounds the size of the file
    leaf      least samples in a leaf
    folds     folds of the cross-validation (5, P20)
    """

    trees: int = 30
    leaves: int = 256
    leaf: int = 5
    folds: int = 5

    def __post_init__(self) -> None:
        for name, low, high in (
            ("trees", 1, 1000),
            ("leaves", 2, 100_000),
            ("leaf", 1, 10_000),
            ("folds", 2, 100),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise HannesError(
                    f"Tree setting {name}={value!r} must be a whole number from {low} to {high}."
                )


@dataclass(frozen=True)
class TrainingData:
    """Samples to learn from.

    values     (n, k) float32 features
    labels     (n,) class numbers
    void       (n,) bool: void by rule, whatever a model says
    closures   (n,) number of the closure
    objects    (n,) number of the object; of a closure on nothing a number of its own
    hands      (n,) number of the hand
    stiffness  (n,) N/m of the object; NaN without one
    """

    values: NDArray[np.float32]
    labels: NDArray[np.int64]
    void: NDArray[np.bool_]
    closures: NDArray[np.int64]
    objects: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    hands: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    stiffness: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        n = len(self.values)
        for name in ("objects", "hands"):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, self.closures)
        if not len(self.stiffness):
            object.__setattr__(self, "stiffness", np.full(n, np.nan))
        sizes = {
            name: len(getattr(self, name))
            for name in ("labels", "void", "closures", "objects", "hands", "stiffness")
        }
        if self.values.ndim != 2 or set(sizes.values()) != {n}:
            raise HannesError(f"Training data do not fit together: values {self.values.shape}, {sizes}.")
        if not np.isfinite(self.values).all():
            raise HannesError("Training data hold values that are not finite.")

    def take(self, rows: NDArray[Any]) -> TrainingData:
        """The given rows (mask or indices)."""
        return TrainingData(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Method:
    """A way to classify: what it is called, the features it takes, its untrained model for a seed and settings, and the
    name under which that takes the samples' weights."""

    title: str
    features: str
    make: Callable[[int, TreeSettings], Any]
    weight: str = "sample_weight"


def _bag(seed: int, settings: TreeSettings) -> Any:
    # A random forest that looks at all features at every split is a bag of trees, and converts to one ONNX operator.
    from sklearn.ensemble import RandomForestClassifier

    return RandomForestClassifier(
        n_estimators=settings.trees,
        max_features=None,
        bootstrap=True,
        random_state=seed,
        max_leaf_nodes=settings.leaves,
        min_samples_leaf=settings.leaf,
    )


def _forest(seed: int, settings: TreeSettings) -> Any:
    # A third of the features at every split, and a tree's share of the samples bounded: a bag of many features at a
    # cost that can be paid.
    return _bag(seed, settings).set_params(max_features=0.33, max_samples=0.3)


def _boosting(seed: int, settings: TreeSettings) -> Any:
    from sklearn.ensemble import GradientBoostingClassifier

    return GradientBoostingClassifier(
        n_estimators=80,
        learning_rate=0.12,
        max_depth=4,
        min_samples_leaf=40,
        subsample=0.35,
        max_features=0.2,
        random_state=seed,
    )


def _network(seed: int, settings: TreeSettings) -> Any:
    from sklearn.neural_network import MLPClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(
        StandardScaler(),
        MLPClassifier(
            hidden_layer_sizes=(48, 24), alpha=1e-3, batch_size=512, max_iter=20, random_state=seed
        ),
    )


def _logistic(seed: int, settings: TreeSettings) -> Any:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), LogisticRegression(C=1.0, max_iter=200))


THESIS_METHOD = "thesis"
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        THESIS_METHOD: Method("bagged trees on single samples", SINGLE_SAMPLE, _bag),
        "forest": Method("bagged trees on windows", WINDOW, _forest),
        "boosting": Method("gradient boosting on windows", WINDOW, _boosting),
        "network": Method("neural network on windows", WINDOW, _network, "mlpclassifier__sample_weight"),
        "logistic": Method(
            "logistic regression on windows", WINDOW, _logistic, "logisticregression__sample_weight"
        ),
    }
)
"""Ways to classify, by name."""


def method_of(name: str) -> Method:
    """A method by name."""
    if name not in METHODS:
        raise HannesError(f"Method {name!r} is unknown; valid are {', '.join(METHODS)}.")
    return METHODS[name]


def fit(
    data: TrainingData, *, seed: int, settings: TreeSettings | None = None, method: str = THESIS_METHOD
) -> Any:
    """A model trained on the data. Raises HannesError where a class is missing.

    The thesis' trees see every sample; the others only those on which no rule decides.
    """
    settings = settings or TreeSettings()
    chosen = method_of(method)
    used = data if chosen.features == SINGLE_SAMPLE else data.take(~data.void)
    missing = [n for k, n in enumerate(STIFFNESS_CLASSES) if not np.any(used.labels == k)]
    if missing:
        raise HannesError(
            f"The training data hold no sample of {' and '.join(missing)}; the classifier needs all of "
            f"{', '.join(STIFFNESS_CLASSES)}."
        )
    model = chosen.make(seed, settings)
    if chosen.features == SINGLE_SAMPLE:
        return model.fit(used.values, used.labels)
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # The network stops after its epochs on purpose: going on would learn the training hands by heart.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(used.values, used.labels, **{chosen.weight: class_weights(used.labels)})


def class_weights(labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Weights (n,) with which rigid and soft count alike.

    How often rigid and soft objects were drawn says nothing of a user's day. How seldom a current above the void
    current comes without a contact is physics of the hand, and stays as it is.
    """
    count = np.maximum(np.bincount(labels, minlength=len(STIFFNESS_CLASSES)), 1)
    weight = np.array([1.0, *(0.5 * count[1:].sum() / count[1:])])
    return np.asarray(weight[labels])


def apply_rules(probabilities: NDArray[np.float64], void: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Probabilities (n, 3) with the samples that are void by rule set to (1, 0, 0)."""
    return np.where(void[:, None], np.array([1.0, 0.0, 0.0]), probabilities)


def grouped_folds(
    groups: NDArray[np.int64], folds: int, seed: int
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Masks (training, held out) of folds that split no group; the groups are dealt out at random."""
    unique = np.unique(groups)
    if len(unique) < folds:
        raise HannesError(f"{len(unique)} groups (closures, objects or hands) are too few for {folds} folds.")
    dealt = np.random.default_rng([seed, 9]).permutation(len(unique)) % folds
    fold = dealt[np.searchsorted(unique, groups)]
    for k in range(folds):
        yield fold != k, fold == k


def cross_validate(
    data: TrainingData,
    *,
    seed: int,
    settings: TreeSettings | None = None,
    method: str = THESIS_METHOD,
    grouping: str = "closures",
) -> NDArray[np.float64]:
    """Probabilities (n, 3) of every sample by models that saw no sample of its group (closure, object or hand)."""
    settings = settings or TreeSettings()
    if grouping not in GROUPINGS:
        raise HannesError(f"Grouping {grouping!r} is unknown; valid are {', '.join(GROUPINGS)}.")
    answer = np.zeros((len(data.labels), len(STIFFNESS_CLASSES)))
    for training, held_out in grouped_folds(getattr(data, grouping), settings.folds, seed):
        model = fit(data.take(training), seed=seed, settings=settings, method=method)
        answer[held_out] = model.predict_proba(data.values[held_out])
    return apply_rules(answer, data.void)


def log_loss(probabilities: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    """Mean of -log of the probability that was given to the truth; smaller is better."""
    return float(-np.mean(np.log(np.clip(probabilities[np.arange(len(labels)), labels], 1e-6, 1.0))))


@dataclass(frozen=True)
class Calibration:
    """p = softmax(weights log p' + bias) of a model's probabilities p': weights (3, 3), bias (3,)."""

    weights: NDArray[np.float64]
    bias: NDArray[np.float64]

    def __post_init__(self) -> None:
        size = len(STIFFNESS_CLASSES)
        if self.weights.shape != (size, size) or self.bias.shape != (size,):
            raise HannesError(
                f"A calibration needs weights ({size}, {size}) and a bias ({size},), not {self.weights.shape} and "
                f"{self.bias.shape}."
            )
        if not (np.isfinite(self.weights).all() and np.isfinite(self.bias).all()):
            raise HannesError("The numbers of a calibration must be finite.")

    @classmethod
    def none(cls) -> Calibration:
        """The one that changes nothing."""
        return cls(np.eye(len(STIFFNESS_CLASSES)), np.zeros(len(STIFFNESS_CLASSES)))

    @classmethod
    def fit(cls, probabilities: NDArray[np.float64], labels: NDArray[np.int64]) -> Calibration:
        """From held-out probabilities (n, 3) and the truth (n,)."""
        from sklearn.linear_model import LogisticRegression

        model = LogisticRegression(C=10.0, max_iter=500).fit(
            _logarithm(probabilities), labels, sample_weight=class_weights(labels)
        )
        if len(model.classes_) != len(STIFFNESS_CLASSES):
            return cls.none()
        return cls(np.asarray(model.coef_, dtype=float), np.asarray(model.intercept_, dtype=float))

    def apply(self, probabilities: NDArray[np.float64]) -> NDArray[np.float64]:
        """Calibrated probabilities (n, 3)."""
        z = _logarithm(probabilities) @ self.weights.T + self.bias
        e = np.exp(z - z.max(axis=1, keepdims=True))
        return e / e.sum(axis=1, keepdims=True)

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for the manifest."""
        return {"weights": self.weights.round(6).tolist(), "bias": self.bias.round(6).tolist()}


def _logarithm(probabilities: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.log(np.clip(probabilities, 1e-4, 1.0))


LEAST_SPREAD = 0.03
"""Least expected error that an estimate may claim, decades."""
COVERAGE = 0.9
"""Part of the estimates whose interval is to hold the truth."""


@dataclass(frozen=True)
class Estimator:
    """The regression: two models of the features, and the factor of the interval.

    value   model of log10 of the stiffness in N/m
    spread  model of the expected error of it, decades
    factor  half the interval over the spread
    held_out  (n, 2) value and spread of the training rows by models that had not seen them; rows (n,) their numbers
    """

    value: Any
    spread: Any
    factor: float
    rows: NDArray[np.intp]
    held_out: NDArray[np.float64]


def _regression(seed: int, trees: int) -> Any:
    from sklearn.ensemble import GradientBoostingRegressor

    return GradientBoostingRegressor(
        n_estimators=trees,
        learning_rate=0.08,
        max_depth=4,
        min_samples_leaf=60,
        subsample=0.35,
        max_features=0.25,
        random_state=seed,
    )


def fit_estimator(data: TrainingData, *, seed: int, folds: int = 5) -> Estimator:
    """The regression of the stiffness, trained on the samples with a contact; folds split no object."""
    rows = np.flatnonzero(~data.void & (data.labels > 0) & np.isfinite(data.stiffness))
    used = data.take(rows)
    target = np.log10(used.stiffness)
    _, number, count = np.unique(used.closures, return_inverse=True, return_counts=True)
    weight = 1.0 / count[number]  # every closure weighs the same, however long it holds
    weight *= len(weight) / weight.sum()
    value, spread = np.zeros(len(rows)), np.zeros(len(rows))
    parts = list(grouped_folds(used.objects, folds, seed))
    for training, held_out in parts:
        model = _regression(seed, 150)
        model.fit(used.values[training], target[training], sample_weight=weight[training])
        value[held_out] = model.predict(used.values[held_out])
    error = np.abs(target - value)
    for training, held_out in parts:
        model = _regression(seed, 50)
        model.fit(used.values[training], error[training], sample_weight=weight[training])
        spread[held_out] = model.predict(used.values[held_out])
    spread = np.maximum(spread, LEAST_SPREAD)
    return Estimator(
        _regression(seed, 150).fit(used.values, target, sample_weight=weight),
        _regression(seed, 50).fit(used.values, error, sample_weight=weight),
        weighted_quantile(error / spread, weight, COVERAGE),
        rows,
        np.column_stack([value, spread]),
    )


def weighted_quantile(values: NDArray[np.float64], weights: NDArray[np.float64], level: float) -> float:
    """The value below which `level` of the weight lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, level * total[-1])])
