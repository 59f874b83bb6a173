"""Solver of a scene with an elastic object: `python -m softfinger.tools.elastic_scenes SCENE` writes its `solution`."""

from __future__ import annotations

import argparse
from typing import Any

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.schema import Mesh
from softfinger.proxy import progress as preparation
from softfinger.proxy.elastic import prepared, solution
from softfinger.proxy.meshes.reading import read_bytes
from softfinger.server.progress import show_progress


def write_solution(scene: Any) -> str:
    """Solve the elastic body of a scene, write it to its file `solution`, and return the path.

    Raises ConfigError if the scene has no such body or file, or the body cannot be solved.
    """
    (obj,) = load_scene(scene).object[:1]
    elastic = obj.elastic if isinstance(obj, Mesh) else None
    if not isinstance(obj, Mesh) or elastic is None or elastic.solution is None:
        raise ConfigError(f"{scene}: has no object.elastic.solution, the file to be written")
    preparation.display = show_progress
    try:
        body = prepared.solve(obj, elastic)
    except ValueError as error:
        raise ConfigError(f"object '{obj.name}': elastic: {obj.file}: {error}") from error
    solution.save(elastic.solution, solution.make_identity(obj, elastic, read_bytes(obj.file)), body)
    return elastic.solution


def main() -> None:
    parser = argparse.ArgumentParser(description="Solve the elastic object of a scene, and write its solution.")
    parser.add_argument("scene", help="scene file, or the name of a shipped one")
    print(write_solution(parser.parse_args().scene))


if __name__ == "__main__":
    main()
