"""States of footage, from its images alone: instruments are tracked with their own learned scene."""
