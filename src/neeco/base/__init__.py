"""The lowest room: errors, files, settings, registry of plug-ins, plausible ranges, locks and workers."""
