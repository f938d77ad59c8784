"""The silhouette of an irregular body against its mesh."""
