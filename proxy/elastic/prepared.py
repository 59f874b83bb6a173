"""Elastic bodies of a scene: from the file to surface and compliance, cached in memory and on disk."""

from __future__ import annotations

import hashlib
import logging
from tempfile import gettempdir
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.proxy import progress
from softfinger.proxy.elastic import solution
from softfinger.proxy.elastic.compliance import compute_vertex_normals, make_patch_loads, solve_patches
from softfinger.proxy.elastic.solid import Solid, is_in_region
from softfinger.proxy.elastic.solution import ElasticBody, Report
from softfinger.proxy.elastic.volume import Volume, compute_quality, fill, find_boundary, read_volume
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.source_hash import SOURCE_HASH
from softfinger.proxy.meshes import array_cache
from softfinger.proxy.meshes.mending import mend
from softfinger.proxy.meshes.reading import Arrays, parse_mesh, read_bytes

Doubles = NDArray[np.float64]

log: Final = logging.getLogger(__name__)

GRAVITY_M_PER_S2: Final = 9.80665
PROBE_POINTS: Final = 5
"""Number of points whose stiffness is reported."""
COARSE_EDGE_RATIO: Final = 1.5
"""Ratio of the edge lengths of the two meshes of which the error is estimated."""
CONVERGENCE_ORDER: Final = 2.0
"""Order of convergence of a patch's displacement: 1.7 to 2.6 on `press-a-pad`, since the strain has no bound where the
fixed region ends."""
BODIES_IN_MEMORY: Final = 4
"""Number of bodies in memory, at most 450 MB each."""
LARGE_DISPLACEMENT_SHARE: Final = 0.1
"""Displacement over the diagonal of the body from which `contact.nonlinear` is set."""

_bodies: Final[dict[str, ElasticBody]] = {}


def prepare_body(obj: schema.Mesh, folder: Folder = array_cache.FOLDER) -> ElasticBody:
    """Return the body of an elastic mesh object, and store it on disk for later runs.

    Raises
    ------
    ConfigError
        If the file, its mesh or a value of [object.elastic] cannot be used.
    """
    assert obj.elastic is not None
    try:
        identity = solution.make_identity(obj, obj.elastic, read_bytes(obj.file))
        if identity not in _bodies:
            body = _load_or_solve(obj, obj.elastic, identity, folder)
            while len(_bodies) >= BODIES_IN_MEMORY:
                _bodies.pop(next(iter(_bodies)))
            _bodies[identity] = body
        return _bodies[identity]
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': file: {error}") from error
    except ValueError as error:
        raise ConfigError(f"object '{obj.name}': elastic: {obj.file}: {error}") from error
    except OSError as error:  # of the temporary file of `Factors`
        raise ConfigError(
            f"object '{obj.name}': elastic: {obj.file}: no temporary file in {gettempdir()}: {error.strerror}: "
            "make room, or set TMPDIR"
        ) from error


def load_stored_body(obj: schema.Mesh, folder: Folder = array_cache.FOLDER) -> ElasticBody | None:
    """Return the body if it was solved before, here or in the file `solution`: for pictures, which do not wait."""
    assert obj.elastic is not None
    try:
        identity = solution.make_identity(obj, obj.elastic, read_bytes(obj.file))
    except ConfigError:  # a file of another machine
        return None
    return _bodies.get(identity) or _load(obj.elastic, identity, folder)[0]


def compile_elastic(obj: schema.Mesh, elastic: schema.Elastic, mesh: model.Triangles) -> model.Elastic:
    """Return the compliance at the vertices of an object's mesh. Raises ConfigError as `prepare_body` does."""
    import softfinger.proxy.kernels.elastic.step  # noqa: F401  registers its step

    body = prepare_body(obj)
    numbers = np.full(len(body.surface.vertices), -1, np.int64)
    numbers[body.nodes] = np.arange(len(body.nodes))
    place = {vertex.tobytes(): number for vertex, number in zip(body.surface.vertices, numbers, strict=True)}
    vertices = mesh.vertices.array.reshape(-1, 3)  # a copy of these, in another order
    nodes = [place[vertex.tobytes()] for vertex in vertices]
    return model.Elastic(
        compliance=body.compliance,
        nodes=ReadOnly(np.array(nodes, np.int64)),
        node_count=float(len(body.nodes)),
        softness=1.0 / elastic.youngs_pa,
        damping=elastic.damping_s,
        bending=body.bending,
        large=LARGE_DISPLACEMENT_SHARE * float(np.linalg.norm(np.ptp(body.surface.vertices, axis=0))),
    )


def _load(elastic: schema.Elastic, identity: str, folder: Folder) -> tuple[ElasticBody | None, str]:
    """Return the body from the file `solution` or from the cache, and a reason if that file is not used."""
    refusal = ""
    if elastic.solution is not None:
        try:
            return solution.read(elastic.solution, identity), ""
        except (OSError, ValueError) as error:
            reason = error.strerror or error if isinstance(error, OSError) else error
            refusal = f"solution {elastic.solution} is not used: {reason}"
    cached = array_cache.load(_make_key(identity), folder)
    return None if cached is None else _from_disk(cached), refusal


def _make_key(identity: str) -> str:
    return hashlib.sha256(repr((SOURCE_HASH, identity)).encode()).hexdigest()


def _load_or_solve(obj: schema.Mesh, elastic: schema.Elastic, identity: str, folder: Folder) -> ElasticBody:
    """Return the body from the file `solution`, from the cache, or by solving."""
    body, refusal = _load(elastic, identity, folder)
    if body is not None:
        return body
    try:
        body = solve(obj, elastic)
    except ValueError as error:
        raise ValueError(f"{error}; {refusal}" if refusal else str(error)) from error
    if refusal:
        log.warning("object '%s': %s; the body was solved", obj.name, refusal)
    array_cache.save(_make_key(identity), _to_disk(body), folder)
    return body


def make_volume(obj: schema.Mesh, resolution_m: float) -> Volume:
    """Return the volume mesh of an object; `resolution_m` does not apply to a file of tetrahedra.

    Raises ConfigError or ValueError if the file cannot be read, its surface is open, or it cannot be filled.
    """
    if obj.file.lower().endswith(obj.volumes):
        return read_volume(obj.file, obj.scale)
    vertices, triangles = parse_mesh(obj.file, read_bytes(obj.file))
    mended = mend(Arrays(vertices * obj.scale, triangles), obj.file.lower().endswith(".stl"))
    if not mended.watertight:
        raise ValueError(f"the mesh is open at {mended.open_edges} edges: close it, or remove [object.elastic]")
    return fill(mended.arrays.vertices, mended.arrays.triangles.astype(np.int64), resolution_m)


def make_solid(volume: Volume, elastic: schema.Elastic) -> Solid:
    """Return the body with its fixed regions. Raises ValueError if they contain fewer than three nodes."""
    return Solid(
        volume, elastic.poisson, lambda points: np.repeat(is_in_region(elastic.fixed, points)[:, None], 3, axis=1)
    )


def solve(obj: schema.Mesh, elastic: schema.Elastic) -> ElasticBody:
    """Mesh and solve a body. Raises ConfigError or ValueError if that is not possible."""
    volume = make_volume(obj, elastic.resolution_m)
    triangles = find_boundary(volume)
    nodes = _find_compliant_nodes(volume, triangles, elastic)
    solid = make_solid(volume, elastic)
    normals = compute_vertex_normals(volume.vertices, triangles)
    loads = make_patch_loads(solid, volume.vertices[nodes], normals[nodes], elastic.radius_m)
    with progress.display(f"compliance of {obj.name}", 3 * len(nodes)) as advance:
        compliance, bending = solve_patches(solid, loads, advance)
    vertices = volume.vertices
    if elastic.density_kg_per_m3 is not None:
        weight = solid.gravity((0.0, 0.0, -GRAVITY_M_PER_S2 * elastic.density_kg_per_m3))
        sag = solid.solve(weight[:, None])[:, 0] / elastic.youngs_pa
        vertices = vertices + sag[solid.basis.nodal_dofs].T
    used, corners = np.unique(triangles, return_inverse=True)
    place = np.searchsorted(used, nodes).astype(np.int32)
    surface = Arrays(np.ascontiguousarray(vertices[used]), corners.reshape(-1, 3).astype(np.int32))
    probes = _spread(volume.vertices[nodes])
    own = np.einsum("ki,kij,kj->k", normals[nodes[probes]], compliance[probes, probes], normals[nodes[probes]])
    error = _estimate_error(obj, elastic, volume.vertices[nodes[probes]], normals[nodes[probes]], own)
    measured = compute_quality(volume)
    report = Report(
        len(volume.vertices), len(volume.tetrahedra), len(nodes), float(measured.min()), float(measured.mean()),
        volume.vertices[nodes[probes]].tolist(), own.tolist(), error,
    )  # fmt: skip
    return ElasticBody(surface, place, ReadOnly(compliance), ReadOnly(bending), report)


def _find_compliant_nodes(volume: Volume, triangles: NDArray[np.int64], elastic: schema.Elastic) -> NDArray[np.int64]:
    """Return the compliant vertices of the surface: outside of `fixed`, and inside of `reach` if that is given."""
    nodes = np.unique(triangles)
    points = volume.vertices[nodes]
    chosen = ~is_in_region(elastic.fixed, points)
    if elastic.reach:
        chosen &= is_in_region(elastic.reach, points)
    nodes = nodes[chosen]
    if len(nodes) == 0:
        raise ValueError("reach: it contains no vertex of the surface outside of `fixed`")
    if len(nodes) > limits.ELASTIC_NODES.high:
        raise ValueError(
            f"{len(nodes):,} compliant surface vertices, at most {int(limits.ELASTIC_NODES.high):,} are supported: use "
            "a larger resolution_m, or limit `reach` to the touched part"
        )
    return nodes


def _spread(points: Doubles) -> NDArray[np.int64]:
    """Return the indices of up to five points, each as far as possible from the previous ones."""
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    distance = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(PROBE_POINTS, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _estimate_error(
    obj: schema.Mesh, elastic: schema.Elastic, points: Doubles, normals: Doubles, own: Doubles
) -> float | None:
    """Return the error of the compliances `own` over the largest, by Richardson's rule; None for a file of one mesh."""
    if obj.file.lower().endswith(obj.volumes):
        return None
    solid = make_solid(make_volume(obj, COARSE_EDGE_RATIO * elastic.resolution_m), elastic)
    compliance = solve_patches(solid, make_patch_loads(solid, points, normals, elastic.radius_m)).compliance
    patches = np.arange(len(points))
    coarse = np.einsum("ki,kij,kj->k", normals, compliance[patches, patches], normals)
    return float(np.abs(coarse - own).max() / own.max() / (COARSE_EDGE_RATIO**CONVERGENCE_ORDER - 1.0))


def _to_disk(body: ElasticBody) -> array_cache.CachedArrays:
    tables = {"nodes": body.nodes, "compliance": body.compliance.array, "bending": body.bending.array}
    return array_cache.CachedArrays({**body.surface._asdict(), **tables}, {"report": body.report._asdict()})


def _from_disk(cached: array_cache.CachedArrays) -> ElasticBody:
    arrays: dict[str, Any] = dict(cached.arrays)
    return ElasticBody(
        surface=Arrays(arrays["vertices"], arrays["triangles"]),
        nodes=arrays["nodes"],
        compliance=ReadOnly(arrays["compliance"]),
        bending=ReadOnly(arrays["bending"]),
        report=Report(**cached.values["report"]),
    )
