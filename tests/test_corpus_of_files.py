"""Files of robosuite, gymnasium-robotics, dm_control and others from the registry load completely, or are refused."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from corpus_of_files import PACKAGES, downloaded, meshes, models

pytestmark = [pytest.mark.exhaustive, pytest.mark.plain]
OF_URDF = ("Error:", "is outside of its folder", "is not found", "several groups")
LIMITS = ("no geom can be touched", "at most", "fingers cannot touch", "not well-formed XML", *OF_URDF)
"""Reasons to refuse a model that MuJoCo accepts; and reasons of MuJoCo to refuse a URDF, of which only the elements are
counted."""


@pytest.fixture(scope="module", params=PACKAGES)
def folder(request: pytest.FixtureRequest) -> Path:
    try:
        return downloaded(request.param)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no package: {error}")


def test_meshes_have_as_many_triangles_as_another_reader_finds(folder: Path) -> None:
    outcomes = list(meshes(folder))
    assert all("\n" not in outcome.refusal for outcome in outcomes)
    assert [outcome for outcome in outcomes if not outcome.refusal and outcome.loaded != outcome.expected] == []
    assert [outcome for outcome in outcomes if outcome.refusal and outcome.expected] == []


def test_models_have_as_many_objects_as_geoms_that_collide(folder: Path) -> None:
    outcomes = list(models(folder))
    assert all("\n" not in outcome.refusal for outcome in outcomes)
    assert [outcome for outcome in outcomes if not outcome.refusal and outcome.loaded != outcome.expected] == []
    alone = [outcome for outcome in outcomes if outcome.refusal and outcome.expected is not None]
    assert [outcome for outcome in alone if not any(limit in outcome.refusal for limit in LIMITS)] == []
