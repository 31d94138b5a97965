"""The example of a new decision in the docs works as printed."""

from docs_examples import run_page


def test_the_example_of_the_docs_runs():
    blocks, names = run_page("new_decision.md")
    assert len(blocks) == 2
    tests = [name for name in names if name.startswith("test_")]
    assert len(tests) == 1 and len(blocks[1].split("def ")[1].splitlines()) < 15
    names[tests[0]]()
