// The messages of docs/wire.md that a controller reads: contacts and hand frames.
#pragma once

#include <array>
#include <cmath>
#include <optional>
#include <unordered_map>

#include "handtouch/msgpack.hpp"

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "columns are little-endian; this reader copies them as they are"
#endif

namespace handtouch {

constexpr std::int64_t schema_version = 1;

enum class PadState : std::uint8_t { clear, touched, stale, lost, faulted, starting, off };
enum class PositionStatus : std::uint8_t { not_computed, valid, unreliable, invalid };
enum class ForceStatus : std::uint8_t { not_computed, valid, lower_bound, unreliable, invalid };
enum class FrameStatus : std::uint8_t { not_computed, valid, stale, invalid };

template <std::size_t N>
using Vector = std::array<double, N>;

// Position, normal and covariance (row by row) in one frame; absent where unknown.
struct Place {
    std::optional<Vector<3>> position_m, normal;
    std::optional<Vector<9>> covariance_m2;
    std::string status = "not_computed";
};

// One of two contacts on a pad at once.
struct ContactPart {
    Place in_link, in_palm, in_base;  // their statuses are those of the contact
    std::optional<double> force_n, force_std_n;
    std::int64_t id = 0;  // the same while it is followed by nearness
};

// `contact/<hand>/<link>`: begin, update or end of one contact. Fields as in docs/wire.md.
struct Contact {
    std::int64_t session = 0, seq = 0, t_ns = 0, begin_ns = 0, id = 0, group = 0;
    std::string event, hand, link, end_reason, calibration_id, force_status;
    bool retained = false;
    bool fresh = true;  // false while samples are missing: values of the last sample
    double duration_s = 0.0, age_s = 0.0, begin_threshold_n = 0.0, end_threshold_n = 0.0;
    Place in_link, in_palm, in_base;
    std::optional<Vector<2>> pad_m;
    double total_current_a = 0.0;
    std::optional<double> force_n, force_std_n, peak_force_n, uncompensated_force_n;
    std::optional<double> residual, residual_std, joints_age_s;
    std::vector<std::string> diagnoses;
    // Force on the pad above a shear pad, in the frames of link, palm and base; covariance in the link's.
    std::string force_vector_status = "not_computed";
    std::optional<Vector<3>> force_vector_n, palm_force_vector_n, base_force_vector_n;
    std::optional<Vector<9>> force_vector_covariance_n2;
    std::optional<Vector<9>> mount_covariance_m2;  // part of in_link.covariance_m2 by the pad's mount
    std::vector<ContactPart> parts;  // two where the currents show two contacts, else empty
};

// A column of a hand frame: N elements for each link; empty where no scene requests it.
template <class T, std::size_t N = 1>
class Column {
public:
    Column() = default;
    Column(std::string_view bytes, std::size_t rows) : values_(rows * N) {
        if (bytes.size() != rows * N * sizeof(T)) throw WireError("a column doesn't match its links");
        std::memcpy(values_.data(), bytes.data(), bytes.size());  // not aligned in the message
    }

    bool empty() const { return values_.empty(); }
    std::size_t size() const { return values_.size() / N; }
    const std::vector<T>& values() const { return values_; }

    // The value of a row, or a pointer to its N values. Throws std::out_of_range for a row that the column
    // lacks, as every row of one that no scene requests.
    auto operator[](std::size_t row) const {
        if (row >= size())
            throw std::out_of_range(empty() ? "the frame lacks this column: no scene requests it"
                                            : "the column has no such row");
        if constexpr (N == 1)
            return values_[row];
        else
            return &values_[row * N];
    }

private:
    std::vector<T> values_;
};

using Scalars = Column<float>;
using Codes = Column<std::uint8_t>;
using Vectors = Column<float, 3>;
using Matrices = Column<float, 9>;

// A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age.
struct NotSampledError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// `hand/<hand>`: the whole hand at one tick; columns have one row per link, NaN where unknown.
struct Frame {
    std::int64_t session = 0, seq = 0, t_ns = 0, tick = 0;
    bool retained = false;
    std::string hand;
    std::vector<std::string> links;
    Codes state, position_status, force_status, palm_status, base_status, force_vector_status;
    Column<std::uint32_t> contact_id, group;
    Column<std::int64_t> sample_ns;
    Scalars total_current_a, force_n, force_std_n, residual, residual_std, joints_age_s;
    Vectors position_m, normal, palm_position_m, palm_normal, base_position_m, base_normal;
    Vectors force_vector_n, palm_force_vector_n, base_force_vector_n;
    Matrices covariance_m2, palm_covariance_m2, base_covariance_m2, force_vector_covariance_n2,
        mount_covariance_m2;
    Column<float, 2> pad_m;

    // The row of a link; look it up once. Throws std::out_of_range.
    std::size_t row(std::string_view link) const {
        for (std::size_t i = 0; i < links.size(); ++i)
            if (links[i] == link) return i;
        std::string known;
        for (const std::string& name : links) known += (known.empty() ? "" : ", ") + name;
        throw std::out_of_range("no link " + std::string(link) + "; the links are " + known);
    }

    // Throws NotSampledError where the pad isn't sampled.
    bool touched(std::size_t row) const {
        if (!sampled(row))
            throw NotSampledError("whether " + links.at(row) + " is touched isn't known: the pad is in state " +
                                  std::to_string(static_cast<int>(state[row])) + ", its last sample " +
                                  std::to_string(age_s(row, t_ns)) + " s old");
        return state_of(row) == PadState::touched;
    }
    // True where the pad is sampled, so that no contact means none.
    bool sampled(std::size_t row) const {
        return state_of(row) == PadState::touched || state_of(row) == PadState::clear;
    }
    PadState state_of(std::size_t row) const { return static_cast<PadState>(state[row]); }
    // Age of the pad's sample at a time on the daemon's monotonic clock; infinite before the first.
    double age_s(std::size_t row, std::int64_t now_ns) const {
        return sample_ns[row] ? 1e-9 * static_cast<double>(now_ns - sample_ns[row]) : HUGE_VAL;
    }
};

namespace detail {

inline std::optional<double> maybe(const Value* value) {
    if (value == nullptr || value->is_nil()) return std::nullopt;
    return value->as_double();
}

template <std::size_t N>
std::optional<Vector<N>> vector(const Value* value) {
    if (value == nullptr || value->is_nil()) return std::nullopt;
    if (value->as_array().size() != N) throw WireError("a vector has another length");
    Vector<N> made;
    for (std::size_t i = 0; i < N; ++i) made[i] = value->items[i].as_double();
    return made;
}

inline Place place(const Value& map, const std::string& prefix, const std::string& status) {
    Place made;
    made.position_m = vector<3>(map.find(prefix + "position_m"));
    made.normal = vector<3>(map.find(prefix + "normal"));
    made.covariance_m2 = vector<9>(map.find(prefix + "covariance_m2"));
    if (const Value* found = map.find(status)) made.status = found->as_text();
    return made;
}

template <class T, std::size_t N>
void read(Column<T, N>& column, const Value& map, const char* name, std::size_t rows, bool optional = false) {
    const Value* found = map.find(name);
    if (found != nullptr)
        column = Column<T, N>(found->as_binary(), rows);
    else if (!optional)
        throw WireError(std::string(name) + " is missing");
}

}  // namespace detail

// Decode a payload as a map of this schema version. Throws WireError.
inline Value decode_payload(std::string_view payload) {
    Value map = decode_msgpack(payload);
    if (map.type != Value::Type::map || map.at("v").as_int() != schema_version)
        throw WireError("another schema version");
    return map;
}

// What a client needs of `service`, the heartbeat.
struct Service {
    std::int64_t session = 0, t_ns = 0;
    double period_s = 0.0, frame_period_s = 0.0;
    bool retained = false, replay = false;
    std::vector<std::string> hands;
};

inline Service decode_service(std::string_view payload) {
    const Value map = decode_payload(payload);
    Service made;
    made.session = map.at("session").as_int();
    made.t_ns = map.at("t_ns").as_int();
    made.period_s = made.frame_period_s = map.at("period_s").as_double();
    if (const Value* period_s = map.find("frame_period_s")) made.frame_period_s = period_s->as_double();
    made.retained = map.at("retained").as_bool();
    if (const Value* replay = map.find("replay")) made.replay = replay->as_bool();
    const Value& hands = map.at("hands");  // name, links, name, links, ...
    for (std::size_t i = 0; i < hands.items.size(); i += 2) made.hands.push_back(hands.items[i].as_text());
    return made;
}

inline Contact decode_contact(std::string_view payload) {
    const Value map = decode_payload(payload);
    Contact made;
    made.session = map.at("session").as_int();
    made.seq = map.at("seq").as_int();
    made.t_ns = map.at("t_ns").as_int();
    made.begin_ns = map.at("begin_ns").as_int();
    made.id = map.at("id").as_int();
    if (const Value* group = map.find("group")) made.group = group->as_int();
    made.event = map.at("event").as_text();
    made.hand = map.at("hand").as_text();
    made.link = map.at("link").as_text();
    made.end_reason = map.at("end_reason").as_text();
    made.calibration_id = map.at("calibration_id").as_text();
    made.force_status = map.at("force_status").as_text();
    made.retained = map.at("retained").as_bool();
    if (const Value* fresh = map.find("fresh")) made.fresh = fresh->as_bool();
    made.duration_s = map.at("duration_s").as_double();
    made.age_s = map.at("age_s").as_double();
    made.begin_threshold_n = map.at("begin_threshold_n").as_double();
    made.end_threshold_n = map.at("end_threshold_n").as_double();
    made.total_current_a = map.at("total_current_a").as_double();
    made.in_link = detail::place(map, "", "position_status");
    made.in_palm = detail::place(map, "palm_", "palm_status");
    made.in_base = detail::place(map, "base_", "base_status");
    made.pad_m = detail::vector<2>(map.find("pad_m"));
    made.force_n = detail::maybe(map.find("force_n"));
    made.force_std_n = detail::maybe(map.find("force_std_n"));
    made.peak_force_n = detail::maybe(map.find("peak_force_n"));
    made.uncompensated_force_n = detail::maybe(map.find("uncompensated_force_n"));
    made.residual = detail::maybe(map.find("residual"));
    made.residual_std = detail::maybe(map.find("residual_std"));
    made.joints_age_s = detail::maybe(map.find("joints_age_s"));
    if (const Value* diagnoses = map.find("diagnoses"))
        for (const Value& kind : diagnoses->as_array()) made.diagnoses.push_back(kind.as_text());
    if (const Value* status = map.find("force_vector_status")) made.force_vector_status = status->as_text();
    made.force_vector_n = detail::vector<3>(map.find("force_vector_n"));
    made.force_vector_covariance_n2 = detail::vector<9>(map.find("force_vector_covariance_n2"));
    made.mount_covariance_m2 = detail::vector<9>(map.find("mount_covariance_m2"));
    made.palm_force_vector_n = detail::vector<3>(map.find("palm_force_vector_n"));
    made.base_force_vector_n = detail::vector<3>(map.find("base_force_vector_n"));
    if (const Value* parts = map.find("parts"))
        for (const Value& part : parts->as_array()) {
            ContactPart read;
            read.in_link = detail::place(part, "", "position_status");
            read.in_palm = detail::place(part, "palm_", "palm_status");
            read.in_base = detail::place(part, "base_", "base_status");
            read.in_link.status = map.at("position_status").as_text();
            read.in_palm.status = made.in_palm.status;
            read.in_base.status = made.in_base.status;
            read.force_n = detail::maybe(part.find("force_n"));
            read.force_std_n = detail::maybe(part.find("force_std_n"));
            if (const Value* id = part.find("id")) read.id = id->as_int();
            made.parts.push_back(read);
        }
    return made;
}

inline Frame decode_frame(std::string_view payload) {
    using detail::read;
    const Value map = decode_payload(payload);
    Frame made;
    made.session = map.at("session").as_int();
    made.seq = map.at("seq").as_int();
    made.t_ns = map.at("t_ns").as_int();
    made.tick = map.at("tick").as_int();
    made.retained = map.at("retained").as_bool();
    made.hand = map.at("hand").as_text();
    for (const Value& link : map.at("links").as_array()) made.links.push_back(link.as_text());
    const std::size_t rows = made.links.size();
    read(made.state, map, "state", rows);
    read(made.contact_id, map, "contact_id", rows);
    read(made.sample_ns, map, "sample_ns", rows);
    read(made.total_current_a, map, "total_current_a", rows);
    read(made.position_m, map, "position_m", rows);
    read(made.normal, map, "normal", rows);
    read(made.covariance_m2, map, "covariance_m2", rows);
    read(made.pad_m, map, "pad_m", rows);
    read(made.position_status, map, "position_status", rows);
    read(made.force_n, map, "force_n", rows);
    read(made.force_std_n, map, "force_std_n", rows);
    read(made.force_status, map, "force_status", rows);
    read(made.residual, map, "residual", rows);
    read(made.residual_std, map, "residual_std", rows);
    read(made.group, map, "group", rows, true);
    read(made.palm_status, map, "palm_status", rows, true);
    read(made.palm_position_m, map, "palm_position_m", rows, true);
    read(made.palm_normal, map, "palm_normal", rows, true);
    read(made.palm_covariance_m2, map, "palm_covariance_m2", rows, true);
    read(made.base_status, map, "base_status", rows, true);
    read(made.base_position_m, map, "base_position_m", rows, true);
    read(made.base_normal, map, "base_normal", rows, true);
    read(made.base_covariance_m2, map, "base_covariance_m2", rows, true);
    read(made.joints_age_s, map, "joints_age_s", rows, true);
    read(made.force_vector_status, map, "force_vector_status", rows, true);
    read(made.force_vector_n, map, "force_vector_n", rows, true);
    read(made.force_vector_covariance_n2, map, "force_vector_covariance_n2", rows, true);
    read(made.mount_covariance_m2, map, "mount_covariance_m2", rows, true);
    read(made.palm_force_vector_n, map, "palm_force_vector_n", rows, true);
    read(made.base_force_vector_n, map, "base_force_vector_n", rows, true);
    return made;
}

}  // namespace handtouch
