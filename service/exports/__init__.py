"""Results as files: one stream of rows in five formats, the files of one run, and records that stand alone."""
