"""What the project says of itself agrees: versions, extras, linters, workflow files."""

import re
import tomllib
from typing import Any

import yaml
from pages import ROOT

from gavo_jax.version import __version__

PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def read_yaml(path: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def test_the_citation_is_of_this_version() -> None:
    citation = read_yaml("CITATION.cff")
    assert citation["version"] == __version__ and citation["license"] == PROJECT["project"]["license"]
    assert [author["family-names"] for author in citation["references"][0]["authors"]][0] == "Djema"


def test_the_changelog_keeps_its_form() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert versions[0] == "Unreleased"
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ - \d{4}-\d\d-\d\d", version) for version in versions[1:])
    kinds = set(re.findall(r"^### (.*)$", text, re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_workflows_test_what_is_allowed() -> None:
    matrix = read_yaml(".github/workflows/tests.yml")["jobs"]["tests"]["strategy"]["matrix"]["include"]
    assert {row["versions"] for row in matrix} == {"oldest", "newest"}
    assert PROJECT["project"]["requires-python"].removeprefix(">=") in {row["python"] for row in matrix}


def test_issues_ask_for_the_doctor() -> None:
    for name in ("bug", "question"):
        fields = read_yaml(f".github/ISSUE_TEMPLATE/{name}.yml")["body"]
        assert any("gavo doctor" in field["attributes"]["label"] for field in fields)


def test_pre_commit_runs_the_linters() -> None:
    hooks = [hook["id"] for repository in read_yaml(".pre-commit-config.yaml")["repos"] for hook in repository["hooks"]]
    assert {"ruff-check", "ruff-format"} <= set(hooks)
