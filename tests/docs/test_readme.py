"""README: that its examples paste into plain `python` and print what they state, and that it stays short."""

from __future__ import annotations

import ast
import re

from helpers import readme

TEXT = readme.README.read_text(encoding="utf-8")


def test_the_examples_print_what_they_state():
    assert readme.differences() == []


def test_every_example_states_what_it_prints():
    assert len(readme.examples(TEXT)) == TEXT.count("```python") == 4
    assert all(readme.stated(block) for block in readme.examples(TEXT))


def test_a_block_that_does_not_paste_or_prints_something_else_is_found():
    pasted = ["for n in range(2):\n    print(n)\nprint(3)\n", "print(1)\n# 2\n", "for n in range(2):\n    print(n)\n"]
    closed = "for n in range(2):\n    print(n)\n\n# 0\n# 1\n"
    syntax, other, waits, right = readme.printed([*pasted, closed])
    assert "SyntaxError" in syntax
    assert other == "1\n" != readme.stated(pasted[1]) == "2\n"
    assert "waits for an empty line" in waits
    assert right == readme.stated(closed)


def test_the_examples_import_at_most_eight_names_of_the_package():
    nodes = [node for block in readme.examples(TEXT) for node in ast.walk(ast.parse(block))]
    own = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module.startswith("kfopc_filterpy")]
    assert len(own) == len(re.findall(r"kfopc_filterpy\b", "".join(readme.examples(TEXT))))  # no plain import of it
    assert len({alias.name for node in own for alias in node.names}) <= 8


def test_it_has_at_most_twelve_links():
    assert len(re.findall(r"\]\(", TEXT)) <= 12
