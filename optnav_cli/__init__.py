"""The observer: pictures in, camera positions out."""
