from .explorer import Explorer as Explorer
from .features import plot_explanation as plot_explanation
from .features import plot_hog as plot_hog
from .features import plot_weights as plot_weights
from .images import plot_patches as plot_patches
from .images import show_images as show_images
from .quality import plot_errors as plot_errors
from .quality import plot_precision_recall as plot_precision_recall
from .quality import plot_tradeoff as plot_tradeoff
from .tracks import plot_tracks as plot_tracks

__all__: list[str]
