"""Helpers for all packages: argument checks, files, threads, progress bars, model files."""

from vehicle_detection._common import check, fields
from vehicle_detection._common.check import Floats, describe, invalid, is_listing, shorten, warn
from vehicle_detection._common.files import (
    atomic_write,
    check_suffix,
    check_target,
    is_hidden,
    make_folder,
    open_locked,
    private_folder,
    temporary_folder,
    walk_files,
    write_text,
)
from vehicle_detection._common.keywords import suggest_keywords, synonyms
from vehicle_detection._common.limits import Limit, check_environment, check_regular_file, read_regular_file
from vehicle_detection._common.model_file import FORMAT_VERSION, model_terms, read_model, write_model
from vehicle_detection._common.parquet import import_pyarrow, open_parquet
from vehicle_detection._common.progress import in_notebook, progress_bar
from vehicle_detection._common.signals import postpone
from vehicle_detection._common.text import (
    encodable,
    hide_credentials,
    is_url,
    is_web_address,
    local_path,
    natural_key,
    parse_number,
    parse_yaml,
    pluralize,
    spreadsheet_text,
    stable_url,
    without_query,
)
from vehicle_detection._common.threads import (
    JOBS_VARIABLE,
    NEW_ARRAYS,
    Closing,
    ThreadTeam,
    Workspace,
    available_cores,
    call_in_thread,
    resolve_jobs,
    single_threaded_opencv,
)
from vehicle_detection._common.units import ROUGH_DISTANCE, UNITS, Units, format_with_error
from vehicle_detection._common.web import (
    NETWORK_DEADLINE,
    NETWORK_TIMEOUT,
    REFUSED,
    download_bytes,
    read_http,
    web_proxy,
)

check_environment()
