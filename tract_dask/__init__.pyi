from .analysis.dose import fit_doses as fit_doses
from .analysis.dose import rebin_frames as rebin_frames
from .analysis.filters import compare_filters as compare_filters
from .readers import open_source as open_source
from .run.pipeline import run as run
from .service.client import ServiceClient as ServiceClient
from .service.notebook import edit_columns as edit_columns
from .simulate.movie import simulate_movie as simulate_movie
from .stages.columns.detect import detect_columns as detect_columns
from .stages.columns.detect import link_detections as link_detections
from .stages.columns.find import find_columns as find_columns
from .stages.columns.sites import lattice_columns as lattice_columns
from .stages.convert.stage import convert as convert
from .stages.drift.stage import estimate_drift as estimate_drift
from .stages.fit.filters import filter_frames as filter_frames
from .stages.fit.lazy import fit_columns as fit_columns
from .stages.sum import sum_image as sum_image
from .store.movie import open_movie as open_movie
from .store.results import accepted as accepted
from .store.results import open_results as open_results

__version__: str
__all__: list[str]
