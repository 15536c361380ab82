"""Alignment of a batch sharded over many devices: this machine's, or all that `jax.distributed` joins."""

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, PRNGKeyArray

from gavo_jax.alignment.pairs import align_rows, starts_of
from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.review import review
from gavo_jax.alignment.stacking import Images, require_untraced, stacked_pairs
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.settings import Settings, as_settings
from gavo_jax.solvers.base import Solver

PAIRS = PartitionSpec("pairs")


@in_32_bits
def align_batch_sharded(
    references: Any,
    targets: Any,
    camera: Camera,
    settings: Settings | Solver | None = None,
    *,
    keys: PRNGKeyArray | None = None,
    guesses: Float[Any, "b 4 4"] | None = None,
) -> Alignment:
    """Align a batch as `align_batch` does, with its B pairs sharded over all devices in one program (`shard_map`).

    Under `jax.distributed`, every process calls it with the same arguments and gets the whole result. Results agree
    with `align_batch` up to rounding, since XLA's order of summation depends on the number of pairs. A random search
    amplifies these differences, by no more than a change of seed would.

    Args:
        references: As in `align_batch`.
        targets: As in `align_batch`.
        camera: As in `align_batch`.
        settings: As in `align_batch`.
        keys: As in `align_batch`.
        guesses: As in `align_batch`.

    Returns:
        As in `align_batch`, in NumPy arrays.

    Raises:
        GavoError: As in `align_batch`.
    """
    require_untraced(references, targets, camera, settings, keys, guesses)
    settings = as_settings(settings)
    sides, keys = stacked_pairs(references, targets, camera, keys)
    count, starts = len(keys), starts_of(guesses, sides, camera, settings)
    mesh = Mesh(np.array(jax.devices()), (PAIRS[0],))

    def align_own(references: Any, targets: Any, keys: Any, guesses: Any) -> Alignment:
        own = (Images(*references), Images(*targets))
        return align_rows(own, camera, settings, jax.random.wrap_key_data(keys), guesses)

    align_all = jax.jit(jax.shard_map(align_own, mesh=mesh, in_specs=PAIRS, out_specs=PAIRS, check_vma=False))
    rows = (*(tuple(side) for side in sides), jax.random.key_data(keys), starts)
    found = align_all(*jax.tree.map(lambda leaf: _laid_out(leaf, mesh), rows))
    found = jax.tree.map(lambda leaf: multihost_utils.process_allgather(leaf, tiled=True)[:count], found)
    return review(found, (references, targets), sides, camera, settings, guesses)


def _laid_out(rows: Any, mesh: Mesh) -> jax.Array:
    """Shard rows over the devices, repeating the last row until they divide evenly."""
    rows = np.asarray(rows)
    missing = -len(rows) % mesh.size
    padded = np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])
    return jax.make_array_from_callback(padded.shape, NamedSharding(mesh, PAIRS), lambda index: padded[index])
