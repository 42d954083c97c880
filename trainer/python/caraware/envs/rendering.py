"""Which `render_mode`s the faces offer, and what their images are."""

import numpy as np
from numpy.typing import NDArray

RENDER_MODES = ["rgb_array"]
"""What the faces offer; a window is a viewer's affair (`caraware view`)."""

RgbImage = NDArray[np.uint8]
"""u8 `[H, W, 3]`, north up."""


def checked_render_mode(render_mode: str | None) -> str | None:
    """`render_mode` itself. Raises `ValueError` for one that the faces do not offer."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode is {render_mode!r}: the faces offer 'rgb_array'; for a window use caraware view")
    return render_mode
