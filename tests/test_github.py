"""Workflows, issue forms and the Dockerfile name what exists; none of them is run here."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"))
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def test_the_workflow_runs_what_ci_runs():
    workflow = yaml.safe_load(
        (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    )
    (job,) = workflow["jobs"].values()
    assert "bash .ci/run" in [step.get("run") for step in job["steps"]]
    assert (ROOT / ".ci" / "run").is_file()
    assert workflow["permissions"] == {"contents": "read"}


@pytest.mark.parametrize("path", FORMS, ids=[path.stem for path in FORMS])
def test_forms_have_the_fields_that_github_requires(path):
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= set(form)
    ids = [field["id"] for field in form["body"]]
    assert len(set(ids)) == len(ids)
    for field in form["body"]:
        assert field["type"] in ("textarea", "input", "dropdown", "checkboxes")
        assert field["attributes"]["label"]


def test_forms_about_data_ask_for_its_check():
    for name in ("bug", "data"):
        text = (ROOT / ".github" / "ISSUE_TEMPLATE" / f"{name}.yml").read_text()
        assert "python -m gsgan.check data=capture" in text


def test_the_dockerfile_copies_what_exists_and_the_wheel_needs():
    ignored = (ROOT / ".dockerignore").read_text().split()
    copied = []
    for line in re.findall(r"^COPY (.+)$", DOCKERFILE, flags=re.M):
        copied += line.split()[:-1]
    for name in copied:
        assert (ROOT / name).exists(), name
        assert f"!{name}" in ignored
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert {"README.md", "LICENSE", "src", "conf"} <= set(copied)
    for extras in re.findall(r"EXTRAS=([\w,]+)", DOCKERFILE):
        known = project["project"]["optional-dependencies"]
        assert set(extras.split(",")) <= set(known)


def test_the_dockerfile_takes_the_tested_torch():
    tested = (ROOT / "constraints.txt").read_text().split()
    for argument, package in (("TORCH", "torch"), ("VISION", "torchvision")):
        (version,) = re.findall(
            rf"^ARG {argument}=(\S+)$", DOCKERFILE, flags=re.M
        )
        assert f"{package}=={version}" in tested
