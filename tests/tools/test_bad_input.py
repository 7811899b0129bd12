"""Every public function and command with bad values of every kind."""

import pytest

from tools import bad_input, bad_input_page


@pytest.fixture(scope="module")
def outcomes():
    return bad_input.run("few")


def test_only_errors_of_the_library_come_back_and_nothing_is_left(outcomes):
    assert outcomes[1] == []


def test_every_public_function_is_called(outcomes):
    commands = {f"`{name}`" for name in bad_input.COMMANDS}
    assert set(outcomes[0]) == (set(bad_input.public_callables()) - bad_input.INTERNAL) | commands
    assert set(bad_input.command_options()) == set(bad_input.COMMANDS)
    refused = sum(each.refused for row in outcomes[0].values() for each in row.values())
    accepted = sum(each.accepted for row in outcomes[0].values() for each in row.values())
    assert refused > 3 * accepted, "most values must be bad for most arguments"


def test_exceptions_to_the_rule_exist():
    names = set(bad_input.public_callables()) | set(bad_input.NOT_CALLED)
    assert names >= bad_input.INTERNAL
    public = {*bad_input.package_names(), *(f"notebook.{name}" for name in bad_input.vd.notebook.__all__)}
    assert public >= bad_input.RESULTS


def test_the_page_says_what_happens(outcomes):
    text = bad_input_page.PAGE.read_text()
    assert bad_input_page.differences(outcomes[0], text) == []


def test_the_page_describes_all_kinds(tmp_path):
    assert list(bad_input_page.KINDS) == list(bad_input.bad_values(tmp_path))
