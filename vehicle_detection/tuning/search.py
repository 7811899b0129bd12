"""The testing system: which parameters are best, by accuracy without leaks, on frames, and by their cost.

Every trial is one row of a table. With a store, a row is on the disk as soon as it is measured: a run that
is killed goes on where it was, and a run with more configurations measures only the new ones.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - switches the next two on
from sklearn.model_selection import HalvingGridSearchCV, HalvingRandomSearchCV, PredefinedSplit

from vehicle_detection._common import check_choice, check_integer, describe
from vehicle_detection.classifier import DEFAULT_C
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    split_groups,
    split_random,
    split_sequences,
    split_sources,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames
from vehicle_detection.params import RegionParams, SearchParams
from vehicle_detection.tuning.cache import FeatureCache
from vehicle_detection.tuning.grid import (
    Configuration,
    describe_params,
    expand_grid,
    read_configurations,
)
from vehicle_detection.tuning.results import ResultTable, RowStore
from vehicle_detection.tuning.runner import Ledger
from vehicle_detection.tuning.trials import COLUMNS, Bench, Recipe

_FEWEST_PATCHES = 300  # With fewer, chance decides who stays.


def make_folds(patch_set: PatchSet, split: str, folds: int, seed: int) -> NDArray[np.intp]:
    """Fold of each patch, 0 to ``folds - 1``: each fold is what the split tests on, out of the rest.

    So ``"sequences"`` cuts each folder into runs of file numbers, and ``"groups"`` keeps near duplicates
    together; groups too large for a fold come into the last one.
    """
    fold_of = np.full(len(patch_set), folds - 1, np.intp)
    rest = np.arange(len(patch_set))
    try:
        for fold in range(folds - 1):
            share = 1 / (folds - fold)
            if split == "sequences":
                parts = split_sequences(patch_set[rest], test_size=share)
            elif split == "groups":
                parts = split_groups(patch_set[rest], test_size=share, random_state=seed)
            else:
                parts = split_random(patch_set[rest], test_size=share, random_state=seed)
            fold_of[rest[parts.test]] = fold
            rest = rest[parts.train]
    except InvalidInputError as error:
        raise InvalidInputError(f"patch_set is too small for folds={folds}: {error}") from error
    for fold in range(folds):
        if any(len(np.unique(patch_set.labels[side])) < 2 for side in (fold_of == fold, fold_of != fold)):
            raise InvalidInputError(
                f"patch_set lacks vehicles or others in or beside fold {fold + 1} of folds={folds}; "
                "use fewer folds or another split"
            )
    return fold_of


def _make_estimator(ledger: Ledger, fold_of: NDArray[np.intp], split: str, seed: int) -> Any:
    """Build an estimator over row numbers that is a recipe, trained when it is scored.

    Only then both sides of the trial are known, and the ledger can tell whether it was run before.
    """

    class Trial(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
        def __init__(self, recipe: Recipe | None = None) -> None:
            self.recipe = recipe

        def fit(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> Trial:
            self.classes_ = np.unique(y)
            self.rows_ = X[:, 0]
            return self

        def score(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> float:
            assert self.recipe is not None
            row = ledger.run(
                self.recipe,
                Split(np.sort(self.rows_), np.sort(X[:, 0])),
                seed,
                name=describe_params(self.recipe.params),
                split_name=f"{split}, fold {fold_of[X[0, 0]] + 1} of {fold_of.max() + 1}",
                stage="halving",
                on_frames=False,
            )
            return math.nan if row["accuracy"] is None else float(row["accuracy"])

    return Trial()


def halve(
    ledger: Ledger,
    recipes: Sequence[Recipe],
    fold_of: NDArray[np.intp],
    *,
    split: str,
    candidates: int | None,
    factor: int,
    seed: int,
) -> list[Recipe]:
    """Drop the worse recipes round by round, on ever more patches; return them best first."""
    # A recipe is one value, so that only the possible combinations of a grid are candidates.
    values: dict[str, Any] = {"recipe": list(recipes)}
    count = min(candidates or len(recipes), len(recipes))
    rounds = int(math.log(count, factor) + 1e-9)
    patches = len(fold_of)
    options: dict[str, Any] = {
        "estimator": _make_estimator(ledger, fold_of, split, seed),
        "factor": factor,
        "min_resources": min(patches, max(patches // factor**rounds, _FEWEST_PATCHES)),
        "cv": PredefinedSplit(fold_of),
        "error_score": "raise",
        "return_train_score": False,
        "refit": False,
        "random_state": seed,
    }
    if count < len(recipes):
        search = HalvingRandomSearchCV(param_distributions=values, n_candidates=count, **options)
    else:
        search = HalvingGridSearchCV(param_grid=values, **options)
    with warnings.catch_warnings():
        # A recipe that cannot be trained has no score; its row says why.
        warnings.filterwarnings("ignore", message="One or more of the test scores are non-finite")
        search.fit(np.arange(patches)[:, None], ledger.bench.labels)
    results = search.cv_results_
    # Who came further is better; within a round the score decides, and NaN comes last.
    scores = np.nan_to_num(results["mean_test_score"], nan=-1.0)
    order = np.lexsort((-scores, -results["iter"]))
    ranked = [results["params"][index]["recipe"] for index in order if scores[index] >= 0]
    return list(dict.fromkeys(ranked))


SPLITS = ("sequences", "groups", "sources", "sources-reversed", "random")
"""Splits by name; the last one leaks near duplicates, as the course's does."""

_SEEDED = ("groups", "random")

Store = str | os.PathLike[str]


def compare_configurations(
    patch_set: PatchSet,
    configurations: Mapping[str, Configuration] | Sequence[Configuration],
    *,
    splits: str | Sequence[str] | Mapping[str, Split] = "sequences",
    C: float | Sequence[float] = DEFAULT_C,
    mirror: bool = True,
    vehicle_weight: float = 1.0,
    seeds: Sequence[int] = (0,),
    frames: LabelledFrames | Sequence[LabelledFrames] | None = None,
    search: SearchParams | None = None,
    fit: RegionParams | None = None,
    time_search: bool = True,
    cache: FeatureCache | str | os.PathLike[str] | None = None,
    store: Store | None = None,
    n_jobs: int | None = None,
    progress: bool = False,
) -> ResultTable:
    """Train and judge every configuration with every C on every split.

    Parameters
    ----------
    patch_set
        The patches.
    configurations
        `FeatureParams`, names of presets, or mappings from fields of `FeatureParams` and from ``C``,
        ``mirror`` and ``vehicle_weight`` to values, as a mapping from names or as a list.
    splits
        One or more of `SPLITS`, or splits of one's own by name. ``"sources"`` trains on GTI and tests on
        KITTI and the Extras, ``"sources-reversed"`` the other way round.
    C, mirror, vehicle_weight
        How to train what does not say it itself; several values of C are all tried. See
        `train_classifier`; a wrong vehicle costs `vehicle_weight` times a wrong non-vehicle.
    seeds
        Seeds of the splits ``"random"`` and ``"groups"``, each a row; other splits take the first.
    frames
        Labelled frames that each classifier is scored on, one by one as stills.
    search, fit
        The detector's parameters on these frames; `search` is timed, too.
    time_search
        Measure the milliseconds that the fast search takes for a 1280x720 frame on one core.
    cache
        A folder that keeps features from run to run, or a `FeatureCache` of these patches to share.
    store
        A ``.csv`` or ``.jsonl`` file that each row is appended to as soon as it is measured. Rows that
        it holds already are not measured again; half a line at its end is dropped.
    n_jobs
        Threads of the feature extraction.
    progress
        Show a bar on standard error.

    Returns
    -------
    ResultTable
        A row for each trial. ``status`` is ``"ok"``; ``"partial"`` where the fast search cannot take the
        features, so that frames and cost are not measured; or ``"refused"``, where the combination is
        impossible. ``message`` says why. ``accuracy`` and ``train_accuracy`` are shares of the patches,
        ``frame_f1`` (at the detector's thresholds), ``frame_best_f1`` (at the best threshold on the
        score), ``frame_average_precision`` and ``frame_iou`` means over the sets of frames,
        ``search_ms`` milliseconds. A row depends on patches, recipe, split, seed, and on the names and labels
        of the frames, not on their pictures.

    Raises
    ------
    InvalidInputError
        If an argument is malformed or names an option that does not exist.
    DatasetError
        If the store is damaged or of another release.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(40)
    >>> patch_set = PatchSet(patches, labels, [f"drawn/{number}.png" for number in range(40)])
    >>> table = compare_configurations(
    ...     patch_set, [{"orient": 4}, {"orient": 0}], splits="random", time_search=False
    ... )
    >>> table.column("status")
    ['ok', 'refused']
    """
    values = [C] if isinstance(C, (int, float)) else list(C)
    if not values:
        raise InvalidInputError("C must be a number or several; got none")
    chosen = _check_seeds(seeds)
    # A configuration that names its C is tried with that one alone.
    candidates = [
        candidate
        for number, value in enumerate(values)
        for candidate in read_configurations(
            configurations, defaults={"C": value, "mirror": mirror, "vehicle_weight": vehicle_weight}
        )
        if number == 0 or "C" not in candidate.options
    ]
    bench = _make_bench(
        patch_set, cache, n_jobs, frames=frames, search=search, fit=fit, time_search=time_search
    )
    trials = list(_plan_splits(patch_set, splits, chosen))
    rows = RowStore(store, COLUMNS)
    # Same features one after the other: a cache that holds one set computes each once.
    order = {name: place for place, name in enumerate(dict.fromkeys(each.name for each in candidates))}
    candidates.sort(key=lambda candidate: order[candidate.name])
    total = sum(1 if each.recipe is None else len(trials) for each in candidates)
    with _bar(progress, total) as bar:
        ledger = Ledger(bench, rows, bar)
        for candidate in candidates:
            if candidate.recipe is None:
                ledger.refuse(candidate, stage="compare")
                continue
            for name, seed, split in trials:
                ledger.run(
                    candidate.recipe, split, seed, name=candidate.name, split_name=name, stage="compare"
                )
    return ledger.table()


def search_parameters(
    patch_set: PatchSet,
    grid: Mapping[str, Iterable[Any]],
    *,
    split: str = "sequences",
    folds: int = 3,
    candidates: int | None = None,
    factor: int = 3,
    finalists: int = 3,
    frames: LabelledFrames | Sequence[LabelledFrames] | None = None,
    search: SearchParams | None = None,
    fit: RegionParams | None = None,
    time_search: bool = True,
    cache: FeatureCache | str | os.PathLike[str] | None = None,
    store: Store | None = None,
    random_state: int = 0,
    n_jobs: int | None = None,
    progress: bool = False,
) -> ResultTable:
    """Search a grid by successive halving, then measure the best with all objectives.

    All candidates are judged on few patches, by cross-validation on folds that do not leak; the best
    ``1 / factor`` of them go on with `factor` times the patches, and so on (scikit-learn's
    ``HalvingGridSearchCV``; Jamieson and Talwalkar, "Non-stochastic best arm identification", 2016). The
    finalists are then trained on the training part of the split, and judged on its test part, on the
    frames, and by the time of their search.

    Parameters
    ----------
    patch_set
        The patches.
    grid
        Lists of values by name: fields of `FeatureParams`, ``C``, ``mirror`` and ``vehicle_weight``. What it
        does not name has its default. Impossible combinations are reported and skipped.
    split
        ``"sequences"``, ``"groups"`` or ``"random"``: what the folds keep together, and the finalists' split.
    folds
        Number of folds.
    candidates
        Number of combinations to draw at random (``HalvingRandomSearchCV``); None takes all.
    factor
        Share of candidates that a round drops, and growth of the patches.
    finalists
        How many of the best are measured in full.
    frames, search, fit, time_search, cache, store, n_jobs, progress
        As in `compare_configurations`.
    random_state
        Seed of drawing, folds and training; the same seed repeats the search, so that a killed one
        goes on from its store.

    Returns
    -------
    ResultTable
        Impossible combinations (stage ``"grid"``), a row for each candidate, fold and number of patches
        (stage ``"halving"``), and the finalists (stage ``"final"``), best first as the halving saw
        them; ``table.where(stage="final").front()`` is what to choose from.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or no combination of the grid is possible.
    DatasetError
        If the store is damaged or of another release.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(60)
    >>> patch_set = PatchSet(patches, labels, [f"drawn/{number}.png" for number in range(60)])
    >>> table = search_parameters(
    ...     patch_set, {"orient": [4], "C": [1e-5, 1e-3]}, split="random", finalists=1, time_search=False
    ... )
    >>> len(table.where(stage="halving")), len(table.where(stage="final"))
    (6, 1)
    """
    check_choice(split, "split", ("sequences", "groups", "random"))
    check_integer(folds, "folds", low=2, high=100)
    check_integer(factor, "factor", low=2, high=100)
    check_integer(finalists, "finalists", low=0)
    seed = check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    if candidates is not None:
        check_integer(candidates, "candidates", low=1)
    defaults = {"C": DEFAULT_C, "mirror": True, "vehicle_weight": 1.0}
    listed = read_configurations(expand_grid(grid), defaults=defaults)
    recipes = list(dict.fromkeys(each.recipe for each in listed if each.recipe is not None))
    if not recipes:
        raise InvalidInputError(f"grid holds no possible combination: {listed[0].fault}")
    bench = _make_bench(
        patch_set, cache, n_jobs, frames=frames, search=search, fit=fit, time_search=time_search
    )
    rows = RowStore(store, COLUMNS)
    fold_of = make_folds(patch_set, split, folds, seed)
    with _bar(progress, None) as bar:
        ledger = Ledger(bench, rows, bar)
        for candidate in listed:
            if candidate.recipe is None:
                ledger.refuse(candidate, stage="grid")
        ranked = halve(ledger, recipes, fold_of, split=split, candidates=candidates, factor=factor, seed=seed)
        names = {each.recipe: each.name for each in listed if each.recipe is not None}
        for name, number, parts in _plan_splits(patch_set, split, (seed,)) if finalists else ():
            for recipe in ranked[:finalists]:
                ledger.run(recipe, parts, number, name=names[recipe], split_name=name, stage="final")
    return ledger.table()


def _plan_splits(
    patch_set: PatchSet, splits: str | Sequence[str] | Mapping[str, Split], seeds: tuple[int, ...]
) -> Iterator[tuple[str, int, Split]]:
    """Name, seed and rows of each split."""
    if isinstance(splits, Mapping):
        if not splits or not all(isinstance(split, Split) for split in splits.values()):
            raise InvalidInputError(f"splits must map names to Split; got {describe(splits)}")
        for name, split in splits.items():
            last = max(int(split.train.max()), int(split.test.max()))
            if last >= len(patch_set):
                raise InvalidInputError(
                    f"splits[{name!r}] names row {last} of a set of {len(patch_set)} patches; "
                    "pass the set it was made from"
                )
            yield str(name), seeds[0], split
        return
    names = (splits,) if isinstance(splits, str) else tuple(splits)
    if not names:
        raise InvalidInputError(f"splits must name at least one of {', '.join(SPLITS)}")
    for name in names:
        check_choice(name, "splits", SPLITS)
        for seed in seeds if name in _SEEDED else seeds[:1]:
            yield name, seed, _split(patch_set, name, seed)


def _split(patch_set: PatchSet, name: str, seed: int) -> Split:
    if name == "random":
        return split_random(patch_set, random_state=seed)
    if name == "groups":
        return split_groups(patch_set, random_state=seed)
    if name == "sequences":
        return split_sequences(patch_set)
    if name == "sources":
        return split_sources(patch_set)
    return split_sources(patch_set, train=("KITTI", "Extras"), test=("GTI",))


def _check_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    given: object = seeds
    if isinstance(given, (str, bytes)) or not isinstance(given, Iterable):
        raise InvalidInputError(f"seeds must be a list of integers, such as range(5); got {describe(given)}")
    chosen = tuple(check_integer(seed, "seeds", low=0, high=2**32 - 1) for seed in given)
    if not chosen or len(set(chosen)) < len(chosen):
        raise InvalidInputError(f"seeds must be different integers, at least one; got {describe(seeds)}")
    return chosen


def _make_bench(
    patch_set: object,
    cache: FeatureCache | str | os.PathLike[str] | None,
    n_jobs: int | None,
    *,
    frames: LabelledFrames | Sequence[LabelledFrames] | None,
    **options: Any,
) -> Bench:
    if not isinstance(patch_set, PatchSet) or not len(patch_set):
        raise InvalidInputError(
            f"patch_set must be a PatchSet with patches, got {describe(patch_set)}; "
            "read one with load_training_patches"
        )
    if not isinstance(cache, FeatureCache):
        cache = FeatureCache(patch_set.patches, folder=cache, n_jobs=n_jobs)
    elif cache.patches is not patch_set.patches:
        raise InvalidInputError("cache must be a FeatureCache of the patches of patch_set; make one of them")
    sets = (frames,) if isinstance(frames, LabelledFrames) else tuple(frames or ())
    for each in sets:
        if not isinstance(each, LabelledFrames):
            raise InvalidInputError(f"frames must be LabelledFrames, one or more; got {describe(each)}")
    if len({each.name for each in sets}) < len(sets):
        raise InvalidInputError("frames must have different names; pass name=")
    return Bench(patch_set, cache, frames=sets, **options)


@contextmanager
def _bar(progress: bool, total: int | None) -> Iterator[Any]:
    """Yield a bar that counts rows, or None."""
    if not progress:
        yield None
        return
    from tqdm.auto import tqdm

    with tqdm(total=total, unit="row", desc="trials") as bar:
        yield bar
