"""The stages of a build: ingest, render, select, check, write; each resumable on a workspace."""
