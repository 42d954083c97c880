"""The driving task beyond learning: SUMO's driver as a teacher, and the trips by which drivers are compared."""
