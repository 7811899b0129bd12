"""Parameter search: configurations, trials, tables of results, and hard negative mining."""

from vehicle_detection.tuning.cache import FeatureCache, digest_of
from vehicle_detection.tuning.grid import TrialConfig, expand_grid, parse_grid
from vehicle_detection.tuning.mining import mine_negatives
from vehicle_detection.tuning.results import (
    RowStore,
    check_column,
    make_table,
    numeric_column,
    pareto_front,
    read_results,
    write_results,
)
from vehicle_detection.tuning.search import compare_configurations, search_parameters
from vehicle_detection.tuning.trials import TrialOptions

__all__ = [
    "FeatureCache", "RowStore", "TrialConfig", "TrialOptions", "check_column", "compare_configurations",
    "digest_of", "expand_grid", "make_table", "mine_negatives", "numeric_column", "pareto_front",
    "parse_grid", "read_results", "search_parameters", "write_results",
]  # fmt: skip
