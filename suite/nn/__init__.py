"""Pieces of networks that are written for a device's sake; tests compare each with the plain way to write it."""
