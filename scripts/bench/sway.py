"""Whether the skeletons of earlier moments tell how the default person's cloth sways.

    python scripts/bench/sway.py

Predicts by how much loose points of the surface leave the skinned character, from the training
frames to the held-out ones, by linear regressions: from the pose, from the pose and the joints'
paths before it, and, with what no skeleton has, from each point's own path. RMS in mm.
"""

from __future__ import annotations

import numpy as np

from gsgan.synthetic.scene_setup import Scene, SceneSettings

LOOSE, EVERY = (
    0.3,
    7,
)  # share of a point's sway; every so many points are predicted
RIDGES = 10.0 ** np.arange(
    -3, 4
)  # the best on held-out frames: a little optimistic
PATHS = {
    "1 and 2 frames before": (1, 2),
    "1/30, 2/30 and 4/30 s before": (0.08, 0.16, 0.32),
    "0.05 to 0.4 s before": (0.12, 0.24, 0.48, 0.72, 0.96),
}  # in frames


def regressed(X, Y, train, test) -> float:
    """The error of a ridge regression in test frames."""
    mean, Z = Y[train].mean(0), (X - X[train].mean(0)) / X[train].std(0).mean()
    K, errors = Z[train] @ Z[train].T, []
    for ridge in RIDGES:
        W = np.linalg.solve(
            K + ridge * len(train) * np.eye(len(train)), Y[train] - mean
        )
        errors.append(rms(Y[test] - mean - Z[test] @ Z[train].T @ W))
    return min(errors)


def by_own_path(d, off, train, test) -> float:
    """The error where each point's sway is linear in its own moves ``d [F, N, 3, K]``."""
    left = []
    for i in range(off.shape[1]):
        A = np.concatenate(
            [d[:, i], np.tile(0.01 * np.eye(3), (len(d), 1, 1))], axis=-1
        )
        a, b = A[train].reshape(-1, A.shape[-1]), off[train, i].ravel()
        w = np.linalg.solve(a.T @ a + 1e-6 * np.eye(a.shape[1]), a.T @ b)
        left.append(A[test] @ w - off[test, i])
    return rms(np.stack(left))


def rms(x) -> float:
    """Of points, in mm."""
    return 1000 * float((3 * (x**2).mean()) ** 0.5)


def main() -> None:
    """The command line."""
    scene = Scene(SceneSettings(motion="choreography"))
    t, source = scene.times, scene.source
    train, test = np.array(scene.train_frames), np.array(scene.test_frames)
    points, off = [], []
    for f in range(len(t)):
        v, normals = scene._skin(f)
        moved, _, _ = scene.secondary(
            float(t[f]), scene.motion.rotations[f], v, normals
        )
        points.append(v)
        off.append(moved - v)
    loose = scene.secondary._loose[scene.secondary._weld]
    keep = np.flatnonzero(loose > LOOSE)[::EVERY]
    sway, points = np.stack(off)[:, keep], np.stack(points)[:, keep]
    Y = sway.reshape(len(t), -1)
    print(f"loose points: {(loose > LOOSE).mean():.1%}")
    print(
        f"none: {rms(Y[test]):.2f}, mean: {rms(Y[test] - Y[train].mean(0)):.2f}"
    )

    def before(lag):
        return source.at(np.clip(t - lag * (t[1] - t[0]), 0, source.duration))

    def surface(at):
        skinned = (
            scene.character.skin(R, p, 0)[0]
            for R, p in zip(at.rotations, at.joints, strict=True)
        )
        return np.stack([v[keep] for v in skinned])

    now = before(0).joints
    pose = (now - now[:, :1]).reshape(len(t), -1)
    print(f"pose: {regressed(pose, Y, train, test):.2f}")
    for name, lags in PATHS.items():
        past = [before(lag) for lag in lags]
        steps = [
            0.3 * (b.joints - now).reshape(len(t), -1) / lag
            for b, lag in zip(past, lags, strict=True)
        ]
        found = regressed(
            np.concatenate([pose, *steps], axis=1), Y, train, test
        )
        own = np.stack([surface(b) - points for b in past], axis=-1)
        print(
            f"{name}: joints {found:.2f}, own path {by_own_path(own, sway, train, test):.2f}"
        )


if __name__ == "__main__":
    main()
