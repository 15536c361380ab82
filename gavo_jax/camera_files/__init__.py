"""Reading of cameras from files of many formats."""
