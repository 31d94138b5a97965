"""One defect a file: each probe looks at a scan and says whether it has that defect, and how to mend it."""
