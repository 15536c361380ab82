"""What a recording does not say of its camera, found from its images: shutter, delay of depth, unit of depth, lens."""
