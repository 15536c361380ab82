"""How folders of image files lie, each dataset in its own way."""
