"""The laboratory of Dwell: runs cells on hosts of their own, harms, measures and judges them."""
