"""The roles of a cell: stamper, workers, sinks and controller, without threads or clocks."""
