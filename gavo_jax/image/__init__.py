"""Operations on a frame's images: pyramid, levels, warp, rolling shutter and sampling."""
