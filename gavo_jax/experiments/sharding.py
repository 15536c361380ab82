"""The batch axis of one program over many devices: those of this machine, or of all hosts that `jax.distributed` joins."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, PRNGKeyArray

from gavo_jax.alignment import Alignment, align_batch
from gavo_jax.camera import Camera
from gavo_jax.errors import GavoError

BATCH = PartitionSpec("batch")
