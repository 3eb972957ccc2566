cimport cython
from libc cimport math
from handtouch.core.stages.rows cimport BodyRow, FeatureRow, SlipRow

cdef Py_ssize_t _COUNT, _WINDOWS, _LINK_WINDOWS, _HAND_WINDOWS, _OTHERS_WINDOW, _PATH_WINDOW, _PATH_STEPS
cdef Py_ssize_t _VELOCITY_WINDOW, _MAX_AGE_NS, _MOTION
cdef double _MIN_PATH_M, _MIN_CURRENT_VARIANCE
cdef double _MAX_LOG_RATIO, _MIN_LOG_RATIO, _MIN_FORCE_N, _CONTACT_VARIANCE_M2
cdef double _OBJECT_SPEED_STD_M_PER_S, _OBJECT_ROTATION_STD_RAD_PER_S, _MAX_HOLDING_LOG_RATIO, _LINK_SPEED_STD_M_PER_S
cdef double _MAX_STICKING_LOG_ODDS
cdef Py_ssize_t _UPDATE_NS
cdef double _ALONE_LOG_ODDS, _OTHERS_WEIGHT, _MAX_OTHERS_LOG_ODDS, _MIN_LOG_ODDS, _ODDS_DECAY_S, _MIN_PIVOT, _NAN, _INFINITY

cdef class EvidenceStage:
    cdef double[::1] history, windows, thresholds, leaves, features, log_odds, ways, velocities, velocity_std, own_odds
    cdef Py_ssize_t[::1] sample_count, steps, hands, tested, evidence_ns, due, sample_ns
    cdef SlipRow[:] slip
    cdef FeatureRow[::1] rows
    cdef BodyRow[::1] body
    cdef Py_ssize_t length, width, levels, trees
    cdef Py_ssize_t pad_m, total_current_a, position_m, palm_position_m, palm_normal, palm_rotation, palm_joints_m2
    @cython.locals(count=Py_ssize_t, k=Py_ssize_t, pad=Py_ssize_t, waits=bint, first=Py_ssize_t, stop=Py_ssize_t)
    cpdef update_odds(self, Py_ssize_t[::1] pads, Py_ssize_t now_ns)
    @cython.locals(pad=Py_ssize_t)
    cpdef compute_velocities(self, Py_ssize_t now_ns)
    @cython.locals(at=Py_ssize_t, origin=Py_ssize_t, others=Py_ssize_t, other=Py_ssize_t, i=Py_ssize_t)
    cpdef bint compare_to_object(self, Py_ssize_t pad, double[::1] out)
    cpdef compute_features(self, Py_ssize_t[::1] pads)

cdef void _update_contact(
    EvidenceStage stage, Py_ssize_t pad, Py_ssize_t others, double total, Py_ssize_t now_ns) noexcept
@cython.locals(at=Py_ssize_t)
cdef bint _is_placed(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(last=Py_ssize_t)
cdef Py_ssize_t _sample_at(EvidenceStage stage, Py_ssize_t pad, Py_ssize_t back) noexcept
@cython.locals(levels=Py_ssize_t, first=Py_ssize_t, node=Py_ssize_t, size=Py_ssize_t, tree=Py_ssize_t,
               leaf=Py_ssize_t, bit=Py_ssize_t, _=Py_ssize_t)
cdef double _sum_trees(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(first=Py_ssize_t, stop=Py_ssize_t, link_window=Py_ssize_t, hand_window=Py_ssize_t, k=Py_ssize_t)
cdef void _compute_features(EvidenceStage stage, Py_ssize_t[::1] pads, Py_ssize_t count) noexcept
@cython.locals(history='double[::1]', ratio=double, force=double, now=Py_ssize_t, before=Py_ssize_t, window=Py_ssize_t, at=Py_ssize_t)
cdef void _compute_own_features(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(at=Py_ssize_t, history='double[::1]', ways='double[::1]', now=Py_ssize_t, before=Py_ssize_t, r=Py_ssize_t, q=Py_ssize_t, n=Py_ssize_t,
               i=Py_ssize_t)
cdef void _compute_link_motion(EvidenceStage stage, Py_ssize_t pad, Py_ssize_t link_window) noexcept
@cython.locals(history='double[::1]', now=Py_ssize_t, at=Py_ssize_t,
               current=Py_ssize_t, steps=Py_ssize_t, before=Py_ssize_t, p=Py_ssize_t, o=Py_ssize_t, i=Py_ssize_t,
               stride=Py_ssize_t, back=Py_ssize_t, later=Py_ssize_t, earlier=Py_ssize_t)
cdef void _compute_path(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(slipping=double, known=double, change=double, at=Py_ssize_t, k=Py_ssize_t)
cdef void _compute_others(
    EvidenceStage stage, Py_ssize_t[::1] pads, Py_ssize_t first, Py_ssize_t stop) noexcept
@cython.locals(history='double[::1]', q=Py_ssize_t, p=Py_ssize_t, o=Py_ssize_t, i=Py_ssize_t)
cdef void _compute_material_way(
    EvidenceStage stage, Py_ssize_t pad, Py_ssize_t now, Py_ssize_t before) noexcept
@cython.locals(back=Py_ssize_t, now=Py_ssize_t, before=Py_ssize_t, last_ns=Py_ssize_t, then_ns=Py_ssize_t,
               i=Py_ssize_t)
cdef void _compute_velocity(EvidenceStage stage, Py_ssize_t pad, Py_ssize_t now_ns) noexcept
@cython.locals(at=Py_ssize_t)
cdef bint _is_known(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(ratio=double)
cdef bint _is_holding(EvidenceStage stage, Py_ssize_t pad) noexcept
@cython.locals(history='double[::1]', known=Py_ssize_t, holding=Py_ssize_t, k=Py_ssize_t,
               at=Py_ssize_t, i=Py_ssize_t, own=bint)
cdef void _compute_relative_motion(
    EvidenceStage stage, Py_ssize_t[::1] pads, Py_ssize_t first, Py_ssize_t stop,
    Py_ssize_t link_window) noexcept
@cython.locals(at=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t)
cdef void _set_point(EvidenceStage stage, Py_ssize_t pad, double x, double y, double z) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t)
cdef void _set_prior(BodyRow[::1] body, double speed, double rotation) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, m=Py_ssize_t)
cdef void _add_point(BodyRow[::1] body, double[::1] ways, Py_ssize_t pad, double weight) noexcept
@cython.locals(normal=Py_ssize_t, i=Py_ssize_t, j=Py_ssize_t, value=double)
cdef double _compare_to_body(EvidenceStage stage, double[::1] ways, Py_ssize_t pad) noexcept
@cython.locals(normal=Py_ssize_t, i=Py_ssize_t)
cdef void _remove_normal(EvidenceStage stage, double[::1] ways, Py_ssize_t pad) noexcept
@cython.locals(j=Py_ssize_t, m=Py_ssize_t, value=double)
cdef void _whiten_row(BodyRow[::1] body, Py_ssize_t i) noexcept
@cython.locals(i=Py_ssize_t, j=Py_ssize_t, m=Py_ssize_t, value=double)
cdef void _factorise(BodyRow[::1] body) noexcept
