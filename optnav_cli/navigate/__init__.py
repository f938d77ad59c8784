"""Navigation of a folder of pictures: choice of method, workers, page."""
