"""Kalman localization of a robot: one EKF and one UKF over exchangeable motion and measurement models.

Source: J. H. Han, Kalman Filter Localization Methods for Autonomous Navigation of a Robot, Chosun University, 2016 (the
thesis).
"""
