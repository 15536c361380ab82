"""One image of a frame: pyramid, levels, warp, shutter and sampling."""
