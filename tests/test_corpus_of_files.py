"""Files of robosuite, gymnasium-robotics and dm_control, where they are installed: loaded in full, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from corpus_of_files import folders, meshes, models

pytestmark = [pytest.mark.exhaustive, pytest.mark.plain]
FOLDERS = folders()


@pytest.mark.parametrize("folder", FOLDERS, ids=[folder.name for folder in FOLDERS])
def test_meshes_have_as_many_triangles_as_another_reader_finds(folder: Path) -> None:
    outcomes = list(meshes(folder))
    assert all("\n" not in each.refusal for each in outcomes)
    assert [each for each in outcomes if not each.refusal and each.found != each.expected] == []
    assert [each for each in outcomes if each.refusal and each.expected] == []


@pytest.mark.parametrize("folder", FOLDERS, ids=[folder.name for folder in FOLDERS])
def test_models_have_as_many_objects_as_geoms_that_collide(folder: Path) -> None:
    """Or they have none, or more than can be touched."""
    outcomes = list(models(folder))
    assert all("\n" not in each.refusal for each in outcomes)
    assert [each for each in outcomes if not each.refusal and each.found != each.expected] == []
    limits = ("no geom can be touched", "at most", "fingers do not touch")
    assert [each for each in outcomes if each.refusal and not any(limit in each.refusal for limit in limits)] == []
