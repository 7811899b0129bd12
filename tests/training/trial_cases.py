"""Small features and searches for the tests of tuning."""

from vehicle_detection.search import SearchBand, SearchParams
from vehicle_detection.training import TrialOptions
from vehicle_detection.training.tuning import Trials

SMALL = {"spatial_size": 8, "hist_bins": 8, "orient": 4, "pix_per_cell": 16, "hog_channel": 0}
SMALL_GRID = {name: [value] for name, value in SMALL.items()}
UNTIMED = TrialOptions(time_search=False)
SEARCH = SearchParams(
    bands=(SearchBand(window=(128, 128), y=(-64, 192)), SearchBand(window=(256, 256), y=(-128, 300)))
)


def count_trials(monkeypatch, stop_after=None):
    """List the configurations that are evaluated, and interrupt the run after some."""
    configs = []
    measure = Trials.measure

    def counted(self, candidate, *arguments, **options):
        if stop_after is not None and len(configs) == stop_after:
            raise KeyboardInterrupt
        configs.append(candidate)
        return measure(self, candidate, *arguments, **options)

    monkeypatch.setattr(Trials, "measure", counted)
    return configs


def without_times(table):
    return table.drop(columns=["fit_seconds", "search_ms"])
