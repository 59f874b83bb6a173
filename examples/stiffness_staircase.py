"""Find an observer's threshold for stiffness by a staircase: two presses a trial, which one was stiffer?

    python examples/stiffness_staircase.py

The observer is simulated: it feels the peak force of each press with a Weber fraction of noise. Two right answers make
the difference smaller and a wrong one larger, which settles where 71 % are right (Levitt 1971). Put a person and a
device in its place and the staircase stays as it is.
"""

from statistics import NormalDist

import numpy as np

from softfinger import Engine

STIFFNESS = "object.table.material.stiffness_n_per_m"
REFERENCE_N_PER_M = 500.0
WEBER = 0.08  # standard deviation of what is felt, as a share of it
REVERSALS = 40
STEP = 1.15  # the difference is multiplied or divided by this


def press(engine: Engine, stiffness: float) -> float:
    """Peak force (N) of a press 1 mm deep, a quarter of a second long."""
    engine.reset()
    engine.set(STIFFNESS, stiffness)
    poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (250, 1))
    poses[:, 2] = 0.010 - 0.001 * np.sin(np.linspace(0.0, np.pi, 250))
    return float(engine.run(poses)["force"][:, 2].max())


def felt(force: float, noise: np.random.Generator) -> float:
    return force * (1.0 + WEBER * noise.standard_normal())


def staircase(engine: Engine, noise: np.random.Generator) -> float:
    """Threshold: the difference, as a share of the reference, that is told apart in 71 % of the trials."""
    difference, right, down, reversals = 0.5, 0, True, []
    while len(reversals) < REVERSALS:
        stiffer = press(engine, REFERENCE_N_PER_M * (1.0 + difference))
        if felt(stiffer, noise) > felt(press(engine, REFERENCE_N_PER_M), noise):
            right += 1
            if right < 2:
                continue
            turned, right = not down, 0
        else:
            turned, right = down, 0
        if turned:
            reversals.append(difference)
            down = not down
        difference *= 1.0 / STEP if down else STEP
    return float(np.exp(np.mean(np.log(reversals[4:]))))  # the first ones are still on the way


def main() -> None:
    threshold = staircase(Engine("paper-plane"), np.random.default_rng(1))
    # Right with probability p where the difference is d: p = Phi(d / (WEBER sqrt(1 + (1 + d)^2))); for p = 0.7071 ...
    z = NormalDist().inv_cdf(np.sqrt(0.5))
    expected = 0.1
    for _ in range(50):  # ... the fixed point of
        expected = z * WEBER * np.sqrt(1.0 + (1.0 + expected) ** 2)
    print(f"threshold {threshold:.1%} of {REFERENCE_N_PER_M:g} N/m; this observer's is {expected:.1%}")


if __name__ == "__main__":
    main()
