"""OpenSpiel's games: in lookup tables where they fit, else stepped on the host."""
