"""Parameter search: configurations, trials, results and hard negatives."""

from vehicle_detection.tuning.cache import FeatureCache, digest_of
from vehicle_detection.tuning.grid import expand_grid, parse_grid
from vehicle_detection.tuning.mining import mine_negatives
from vehicle_detection.tuning.results import ResultTable, RowStore, read_results
from vehicle_detection.tuning.search import compare_configurations, search_parameters
from vehicle_detection.tuning.trials import Recipe, fit_features

__all__ = [
    "FeatureCache",
    "Recipe",
    "ResultTable",
    "RowStore",
    "compare_configurations",
    "digest_of",
    "expand_grid",
    "fit_features",
    "mine_negatives",
    "parse_grid",
    "read_results",
    "search_parameters",
]
