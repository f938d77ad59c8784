"""Pictures and what is known about each: picture folders, single files, ISIS cubes."""
