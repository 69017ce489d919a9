"""The page of the leaderboards: one HTML file that needs no server and no network."""
