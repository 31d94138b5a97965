"""One question to the data a file; `plan.order` says when each is asked."""
