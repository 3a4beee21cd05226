"""Plain English: phrases that a native writer would rarely use are counted, and their number may only fall.

The count is a symptom. If a sentence needs one of these words, use it and mend another one; do not raise a ceiling.
"""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STILTED = re.compile(
    r"""\b(?:
        anew | beside | alone | likewise | at\ hand | in\ place\ of | for\ ever | wants | told | tells | serves?
      | by\ (?:it|them)sel(?:f|ves) | (?:so|as)\ many | whoever | nobody | somebody | (?:that|those)\ of
      | of\ (?:yours|(?:your|its|one's|their)\ own) | (?<!there\ )(?:is|are)\ (?:no|none)
      | (?:bytes|words|entry|number|one|cases?)\ an?\ (?:node|axis|step|lane|kernel)
    )\b | (?<![\w.\])])\.\d""",
    re.VERBOSE | re.IGNORECASE,
)
OPENERS = re.compile(r"(?:What|Whether|Where|How|As|Of|Whatever)\b")
FILES = {
    "package": sorted((ROOT / "hjbjax").rglob("*.py")),
    "pages": [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))],
    "notebooks": sorted((ROOT / "notebooks").glob("*.py")),
    "changelog": [ROOT / "CHANGELOG.md"],
}
PER_THOUSAND = {
    "package": 0.5,
    "pages": 0.6,
    "notebooks": 1.0,
    "changelog": 1.0,
}  # words; lower these, never raise them
OPENING = 0  # docstrings that open with a question word or a preposition


def docstrings(tree: ast.AST) -> list[str]:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = (ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, kinds))
    return [each for each in found if each]


def text_of(path: Path) -> str:
    """What people read in a file: Markdown outside of code; docstrings, comments and messages of Python."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return re.sub(r"```.*?```", "", source, flags=re.DOTALL)
    tree = ast.parse(source)
    described = docstrings(tree)
    constants = (
        node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    messages = [each for each in constants if " " in each and each not in described]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return "\n".join([*described, *messages, *(t.string for t in tokens if t.type == tokenize.COMMENT)])


def test_the_count_sees_what_it_counts():
    assert len(STILTED.findall("those of nobody, told anew in .4 s; there is no other, but it is no chain")) == 6


@pytest.mark.parametrize("group", FILES)
def test_stilted_phrases_become_fewer(group):
    texts = {path: text_of(path) for path in FILES[group]}
    found = sum(len(STILTED.findall(text)) for text in texts.values())
    words = sum(len(text.split()) for text in texts.values())
    assert words > 1000
    assert 1000 * found / words <= PER_THOUSAND[group]


def test_docstrings_open_with_a_verb_or_a_noun():
    opening = [
        f"{path.relative_to(ROOT)}: {text.splitlines()[0]}"
        for path in FILES["package"]
        for text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if OPENERS.match(text)
    ]
    assert len(opening) <= OPENING, opening
