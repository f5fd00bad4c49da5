"""Files, folders, names and CRSs that someone hostile has made, and what is asked of them."""
