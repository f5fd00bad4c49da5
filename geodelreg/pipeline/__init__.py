"""The method: `register` is the whole of it on one page; it opens no file and prints nothing."""
