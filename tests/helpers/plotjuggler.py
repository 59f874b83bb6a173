"""PlotJuggler's rules for a ZeroMQ stream, as found by probing it; each is named by its violation."""

import math

import msgpack

EPOCH_AFTER_S = 1e9
"""Times since the epoch are above this; the uptime of a machine is below."""


def complaints(frames, monotonic=()):
    """Return the faults that PlotJuggler would have with a list of frames; `monotonic`: topics of another clock."""
    if len(frames) != 2:
        return [f"{len(frames)} frames: it takes the second as the map, and may abort"]
    topic, body = frames
    try:
        message = msgpack.unpackb(body, strict_map_key=False)
    except ValueError as error:
        return [f"no msgpack: {error}"]
    if not isinstance(message, dict):
        return ["no map"]
    faults = []
    timestamp = message.get("timestamp")
    if not isinstance(timestamp, float):
        faults.append("no timestamp as a float: it uses the time of receipt for ever")
    elif (timestamp > EPOCH_AFTER_S) == (topic.decode() in monotonic):
        faults.append(f"timestamp {timestamp} is of another clock than the other topics'")
    series = {}
    _walk("", message, series, faults)
    return faults


def _walk(name, value, series, faults):
    if isinstance(value, dict):
        for key, child in value.items():
            if not isinstance(key, str):
                faults.append(f"key {key!r} of {name or 'the map'} is not text")
            else:
                _walk(f"{name}/{key}" if name else key, child, series, faults)
    elif isinstance(value, list):
        for i, child in enumerate(value):
            _walk(f"{name}[{i}]", child, series, faults)
    elif isinstance(value, bool | int | float):
        if name in series:
            faults.append(f"two values for the series {name}")
        if not math.isfinite(value):
            faults.append(f"{name} is {value}: an empty series")
        series[name] = value
    elif not isinstance(value, str):  # PlotJuggler ignores it
        faults.append(f"{name} is a {type(value).__name__}, which it does not read")


def prefix_complaints(topics):
    """Return topics that are prefixes of other topics, which PlotJuggler's filter would mix."""
    return [(a, b) for a in topics for b in topics if a != b and b.startswith(a)]
