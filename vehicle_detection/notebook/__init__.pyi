from .explorer import Explorer as Explorer
from .features import plot_channels as plot_channels
from .features import plot_explanation as plot_explanation
from .features import plot_features as plot_features
from .features import plot_hog as plot_hog
from .features import plot_weights as plot_weights
from .images import ImageDescription as ImageDescription
from .images import describe_image as describe_image
from .images import plot_balance as plot_balance
from .images import plot_methods as plot_methods
from .images import plot_near_duplicates as plot_near_duplicates
from .images import plot_patches as plot_patches
from .images import show_images as show_images
from .quality import plot_errors as plot_errors
from .quality import plot_f1 as plot_f1
from .quality import plot_parameter as plot_parameter
from .quality import plot_precision_recall as plot_precision_recall
from .quality import plot_scores as plot_scores
from .quality import plot_tradeoff as plot_tradeoff
from .search import plot_bands as plot_bands
from .search import plot_comparison as plot_comparison
from .search import plot_heatmap as plot_heatmap
from .search import plot_speedups as plot_speedups
from .search import plot_windows as plot_windows
from .tracks import plot_stage_times as plot_stage_times
from .tracks import plot_tracks as plot_tracks

__all__: list[str]
