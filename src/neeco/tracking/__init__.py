"""States of footage, from its images alone: instruments are followed by their own learned scene."""
