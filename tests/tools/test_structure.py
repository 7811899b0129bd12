"""The table of the structure: circles, upward imports, lines of code and walks."""

import ast

from tools import structure


def test_circles_are_groups_of_modules_that_reach_each_other():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set(), "f": {"d"}}
    assert structure.find_circles(graph) == [["a", "b", "c"]]


def test_upward_imports():
    package = "vehicle_detection."
    assert structure.is_upward(package + "search", package + "course.heat")
    assert structure.is_upward(package + "course.heat", package + "scenes")
    assert not structure.is_upward(package + "course.heat", package + "search")
    assert not structure.is_upward(package + "cli.demo", package + "scenes")


def test_lines_of_code_are_without_docstring_comments_and_blank_lines():
    source = 'def f(a,\n      b):\n    """Two\n    lines."""\n\n    # comment\n    return (a\n    )\n'
    (function,) = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
    assert structure.code_lines(source, function) == 4


def test_a_walk_counts_files_and_calls_between_them():
    from vehicle_detection.images import read_image

    image = structure.ROOT / "test_images" / "road1.jpg"
    read_image(image)
    files, calls = structure.count_walk(lambda: read_image(image))
    assert files >= 2
    assert calls >= files
    assert structure.count_walk(lambda: None) == (0, 0)
