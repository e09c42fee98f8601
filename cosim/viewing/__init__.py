"""Signal browser: rows of any number of runs with extremes of blocks, served to one page of this machine."""
