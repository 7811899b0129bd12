import logging
from types import SimpleNamespace

from vehicle_detection._kernels import suppress
from vehicle_detection._kernels.jit import _Announcement


def test_compiling_kernels_is_logged_once_and_other_functions_are_not(caplog):
    announcement = _Announcement()
    functions = logging.getLogger, suppress, suppress
    with caplog.at_level(logging.INFO, "vehicle_detection._kernels"):
        for function in functions:
            dispatcher = SimpleNamespace(py_func=getattr(function, "py_func", function))
            announcement.on_start(SimpleNamespace(data={"dispatcher": dispatcher}))
    assert [record.getMessage()[:9] for record in caplog.records] == ["compiling"]
