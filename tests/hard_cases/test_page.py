"""The page made of the hard cases."""

import ast

import pytest

from tests.hard_cases.page import HERE, ORDER, PAGE, make_page, read_case


def test_the_page_in_the_docs_is_the_one_that_the_tests_make() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), "python -m tests.hard_cases.page writes it anew"


def test_every_module_of_hard_cases_is_on_the_page() -> None:
    assert {f"test_{name}.py" for name in ORDER} == {path.name for path in HERE.glob("test_*.py")} - {"test_page.py"}


def test_a_case_that_does_not_say_what_holds_is_refused() -> None:
    (test,) = ast.parse('def test_it():\n    """What it is. Could go wrong: all."""').body
    assert isinstance(test, ast.FunctionDef)
    with pytest.raises(ValueError, match="Holds"):
        read_case(test)
