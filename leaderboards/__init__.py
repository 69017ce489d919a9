"""Published results: scores, statistics, boards as CSV files, and the page."""
