// The messages of docs/wire.md that a controller reads: contacts and hand frames.
#pragma once

#include <cmath>
#include <unordered_map>

#include "handtouch/fields.hpp"

namespace handtouch {

constexpr std::int64_t schema_version = 1;

// A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age.
struct NotSampledError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// `hand/<hand>`: the whole hand at one tick; columns have one row per link, NaN where unknown.
struct Frame : FrameColumns {
    std::int64_t session = 0, seq = 0, t_ns = 0, tick = 0;
    bool retained = false;
    std::string hand;
    std::vector<std::string> links;

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

inline void read(std::int64_t& made, const Value& value) { made = value.as_int(); }
inline void read(double& made, const Value& value) { made = value.as_double(); }
inline void read(bool& made, const Value& value) { made = value.as_bool(); }
inline void read(std::string& made, const Value& value) { made = value.as_text(); }
inline void read(std::vector<std::string>& made, const Value& value) {
    for (const Value& text : value.as_array()) made.push_back(text.as_text());
}

template <std::size_t N>
void read(Vector<N>& made, const Value& value) {
    if (value.as_array().size() != N) throw WireError("a vector has another length");
    for (std::size_t i = 0; i < N; ++i) made[i] = value.items[i].as_double();
}

template <class T>
void read(std::optional<T>& made, const Value& value) {
    if (value.is_nil()) return;
    made.emplace();
    read(*made, value);
}

inline void read(std::vector<ContactPart>& made, const Value& value);

// Read the fields of a map; what may be nil may be absent, too.
struct FieldReader {
    const Value& map;

    template <class T>
    void operator()(const char* name, T& field, bool optional) const {
        if (optional) read_if_present(name, field);
        else read(field, map.at(name));
    }
    template <class T>
    void operator()(const char* name, std::optional<T>& field, bool) const {
        read_if_present(name, field);
    }

private:
    template <class T>
    void read_if_present(const char* name, T& field) const {
        if (const Value* found = map.find(name)) read(field, *found);
    }
};

inline void read(std::vector<ContactPart>& made, const Value& value) {
    for (const Value& map : value.as_array()) each_field_of_contact_part(made.emplace_back(), FieldReader{map});
}

// Read columns of so many rows.
struct ColumnReader {
    const Value& map;
    std::size_t rows;

    template <class T, std::size_t N>
    void operator()(const char* name, Column<T, N>& column, bool optional) const {
        const Value* found = map.find(name);
        if (found != nullptr)
            column = Column<T, N>(found->as_binary(), rows);
        else if (!optional)
            throw WireError(std::string(name) + " is missing");
    }
};

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
    each_field_of_contact(made, detail::FieldReader{map});
    for (ContactPart& part : made.parts) {
        part.in_link.status = made.in_link.status;
        part.in_palm.status = made.in_palm.status;
        part.in_base.status = made.in_base.status;
    }
    return made;
}

inline Frame decode_frame(std::string_view payload) {
    const Value map = decode_payload(payload);
    Frame made;
    made.session = map.at("session").as_int();
    made.seq = map.at("seq").as_int();
    made.t_ns = map.at("t_ns").as_int();
    made.tick = map.at("tick").as_int();
    made.retained = map.at("retained").as_bool();
    made.hand = map.at("hand").as_text();
    detail::read(made.links, map.at("links"));
    each_field_of_frame_columns(made, detail::ColumnReader{map, made.links.size()});
    return made;
}

}  // namespace handtouch
