"""Videos in the naming of YCB-Video (Xiang et al. 2018), as first published; its BOP version is another layout."""

from pathlib import Path
from typing import ClassVar

from gavo_jax.datasets.depth_unit import TENTHS
from gavo_jax.datasets.layouts.plain_folder import PlainFolder


class YcbVideo(PlainFolder):
    """A folder of `000001-color.png`, `000001-depth.png` and `000001-meta.mat`, whose `factor_depth` is 10000."""

    kind: ClassVar[str] = "YCB-Video sequence"
    scale_is_open: ClassVar[bool] = False
    DEPTH_SCALE: ClassVar[float] = TENTHS

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the names of its files."""
        return all(any(path.glob(f"*-{name}")) for name in ("meta.mat", "color.*", "depth.png"))
