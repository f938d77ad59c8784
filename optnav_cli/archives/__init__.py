"""Pictures of archives: labels, cubes and kernels made into picture folders."""
