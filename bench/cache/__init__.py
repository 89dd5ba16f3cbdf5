"""Caches on disk. Every result is stored under the hash of its inputs."""
