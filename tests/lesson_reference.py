"""The reference of the course with the keyword of two earlier quizzes; both modules are interchangeable."""

from vehicle_detection.course import reference
from vehicle_detection.course.reference import *  # noqa: F403


def extract_features(imgs, *args, cspace=None, **options):
    if cspace is not None:  # one quiz of HOG alone, one of colors alone
        hog = "orient" in options
        options |= {"color_space": cspace, "spatial_feat": not hog, "hist_feat": not hog, "hog_feat": hog}
    return reference.extract_features(imgs, *args, **options)
