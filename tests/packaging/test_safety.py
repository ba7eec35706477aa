"""Nothing in the project runs code that it reads: no pickle, no unsafe YAML, no eval, no shell."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from workspace import SOURCES

ROOT = SOURCES.parents[1]
FILES = sorted(file for folder in (SOURCES, ROOT / "tools", ROOT / "bench") for file in folder.rglob("*.py"))
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "shelve", "marshal", "skops"}
FORBIDDEN_CALLS = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.unsafe_load", "yaml.full_load",
    "yaml.load_all", "yaml.UnsafeLoader", "yaml.FullLoader", "joblib.load", "joblib.dump", "numpy.save", "np.save",
}  # fmt: skip


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Name):
        return node.id
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def catches_all(handler: ast.ExceptHandler) -> bool:
    return handler.type is None or dotted(handler.type) in ("Exception", "BaseException")


def offences(file: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name.split(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            modules = [node.module.split(".")[0]]
        found += [f"{node.lineno}: imports {module}" for module in modules if module in FORBIDDEN_MODULES]
        if isinstance(node, ast.Call):
            name = dotted(node.func)
            if name in FORBIDDEN_CALLS:
                found.append(f"{node.lineno}: calls {name}")
            if name in ("yaml.load", "yaml.load_all") and "SafeLoader" not in ast.unparse(node):
                found.append(f"{node.lineno}: {name} without a safe loader")
            for keyword in node.keywords:
                if keyword.arg in ("shell", "allow_pickle") and not (
                    isinstance(keyword.value, ast.Constant) and keyword.value.value is False
                ):
                    found.append(f"{node.lineno}: {name}({keyword.arg}=...)")
            if name in ("np.load", "numpy.load") and not any(k.arg == "allow_pickle" for k in node.keywords):
                found.append(f"{node.lineno}: {name} without allow_pickle=False")
        if isinstance(node, ast.ExceptHandler) and catches_all(node) and isinstance(node.body[0], ast.Pass):
            found.append(f"{node.lineno}: swallows every exception")
    return found


@pytest.mark.parametrize("file", FILES, ids=[str(file.relative_to(ROOT)) for file in FILES])
def test_reads_nothing_that_runs(file: Path) -> None:
    assert offences(file) == []


def test_the_check_sees_what_it_should(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import pickle, yaml\nyaml.load('a')\neval('1')\ntry:\n    pass\nexcept Exception:\n    pass\n"
    )
    assert len(offences(bad)) == 4
