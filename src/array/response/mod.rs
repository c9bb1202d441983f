//! How a pair answers to the sky: rows of the beam matrix B. (to come)
