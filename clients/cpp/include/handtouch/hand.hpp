// The newest state of a hand, for a control loop.
//
//     handtouch::Hand hand("right");
//     while (const handtouch::Frame* frame = hand.wait(std::chrono::milliseconds(100)))
//         for (const auto& [link, contact] : hand.contacts()) ...
#pragma once

#include <zmq.h>

#include <algorithm>
#include <chrono>
#include <fstream>
#include <functional>
#include <iostream>
#include <map>
#include <memory>

#include "handtouch/messages.hpp"

namespace handtouch {

// The daemon has no such hand; the text names those that it has.
struct UnknownNameError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// A client's CURVE keys, of a file by `handtouch keys client`.
struct ClientKey {
    std::string server_key, public_key, secret_key;

    // Throws std::runtime_error for a file without the three keys.
    static ClientKey load(const std::string& path) {
        std::map<std::string, std::string> values;
        std::ifstream file(path);
        for (std::string line; std::getline(file, line);) {
            const auto begin = line.find(" = \"");
            const auto end = line.rfind('"');
            if (begin != std::string::npos && begin + 4 <= end)
                values[line.substr(0, begin)] = line.substr(begin + 4, end - begin - 4);
        }
        for (const char* name : {"server_key", "public_key", "secret_key"})
            if (values[name].size() != 40)
                throw std::runtime_error(path + ": no " + name + "; make it with `handtouch keys client`");
        return {values["server_key"], values["public_key"], values["secret_key"]};
    }
};

// Newest frame and contacts from decoded messages; needs no socket.
class HandState {
public:
    // The newest frame of the session, or nullptr.
    const Frame* frame() const { return frame_ ? &*frame_ : nullptr; }

    // Period of the hand's frames, as `service` states it; 0 before the first.
    std::int64_t period_ns() const { return period_ns_; }
    bool is_replay() const { return is_replay_; }
    // Number of the newest frame in the order of reception.
    std::int64_t frame_order() const { return frame_order_; }
    std::int64_t session() const { return session_; }

    // Active contacts by link: also without the message of an end, once a frame shows it.
    std::map<std::string, Contact> contacts() const {
        std::map<std::string, Contact> active;
        for (const auto& [link, entry] : contacts_)
            if (entry.order > live_order_ || frame_shows(entry.contact)) active.emplace(link, entry.contact);
        return active;
    }

    // `order`: number of the message in the order of reception.
    void feed(Contact contact, std::int64_t order) {
        if (!accept(contact.session, order)) return;
        if (contact.event == "end") {
            contacts_.erase(contact.link);
        } else {
            Entry& entry = contacts_[contact.link];
            entry = {order, std::move(contact)};
        }
    }

    void feed(Frame frame, std::int64_t order) {
        if (!accept(frame.session, order) || (frame_ && frame.seq <= frame_->seq)) return;
        frame_order_ = order;
        if (!frame.retained) live_order_ = order;  // a retained one may be older than a contact before it
        frame_ = std::move(frame);
    }

    void feed(const Service& service, std::int64_t order) {
        if (!accept(service.session, order)) return;
        period_ns_ = static_cast<std::int64_t>(1e9 * service.frame_period_s);
        is_replay_ = service.replay;
    }

private:
    struct Entry {
        std::int64_t order = 0;
        Contact contact;
    };

    // Another session voids the state, unless the message was received before those of this one.
    bool accept(std::int64_t session, std::int64_t order) {
        if (session != session_) {
            if (order < newest_order_) return false;
            frame_.reset();
            contacts_.clear();
            period_ns_ = 0;
            is_replay_ = false;
            session_ = session;
        }
        newest_order_ = std::max(order, newest_order_);
        return true;
    }

    bool frame_shows(const Contact& contact) const {
        if (!frame_) return false;
        const auto found = std::find(frame_->links.begin(), frame_->links.end(), contact.link);
        return found != frame_->links.end() &&
               frame_->contact_id[static_cast<std::size_t>(found - frame_->links.begin())] == contact.id;
    }

    std::optional<Frame> frame_;
    std::map<std::string, Entry> contacts_;
    std::int64_t frame_order_ = -1, live_order_ = -1, newest_order_ = -1, session_ = -1;
    std::int64_t period_ns_ = 0;
    bool is_replay_ = false;
};

// A connection to a daemon that keeps the newest state of one hand. Not thread-safe.
class Hand {
public:
    using Clock = std::chrono::steady_clock;  // CLOCK_MONOTONIC, the clock of t_ns on the daemon's machine

    // Called by `latest` and `wait` for every begin, update and end of a contact.
    std::function<void(const Contact&)> on_contact;

    // `max_age`: age of a frame up to which it counts; 0: three of the hand's periods, 50 ms at least. Throws
    // std::runtime_error for an invalid endpoint or key.
    explicit Hand(const std::string& name, const std::string& endpoint = "tcp://127.0.0.1:5580",
                  const ClientKey* key = nullptr, std::chrono::nanoseconds max_age = {})
        : max_age_ns_(max_age.count()), is_local_(is_local(endpoint)), name_(name), endpoint_(endpoint),
          frame_topic_("hand/" + name), contact_prefix_("contact/" + name + "/"), context_(zmq_ctx_new()),
          socket_(zmq_socket(context_.get(), ZMQ_SUB)), monitor_(zmq_socket(context_.get(), ZMQ_PAIR)) {
        check(zmq_socket_monitor(socket_.get(), monitor_endpoint, ZMQ_EVENT_DISCONNECTED), "monitor");
        check(zmq_connect(monitor_.get(), monitor_endpoint), "monitor");
        set(ZMQ_RCVHWM, 10000);
        set(ZMQ_LINGER, 0);
        set(ZMQ_TCP_KEEPALIVE, 1);
        set(ZMQ_TCP_KEEPALIVE_IDLE, 1);
        set(ZMQ_TCP_KEEPALIVE_INTVL, 1);
        set(ZMQ_TCP_KEEPALIVE_CNT, 2);
        set(ZMQ_RECONNECT_IVL, 50);
        set(ZMQ_RECONNECT_IVL_MAX, 1000);
        if (key != nullptr) {
            set(ZMQ_CURVE_SERVERKEY, key->server_key);
            set(ZMQ_CURVE_PUBLICKEY, key->public_key);
            set(ZMQ_CURVE_SECRETKEY, key->secret_key);
        }
        for (const std::string& prefix : {frame_topic_, contact_prefix_, std::string("service")})
            set(ZMQ_SUBSCRIBE, prefix);
        check(zmq_connect(socket_.get(), endpoint.c_str()), endpoint);
    }

    // The newest frame that has arrived; never blocks. nullptr before the first, without a daemon, and while the
    // newest is older than `max_age` by its own time. Valid until the next call of `latest` or `wait`. Throws
    // UnknownNameError while the daemon has no hand of this name. Nothing received for 2 s is logged once.
    const Frame* latest() {
        drain();
        if (received_ == 0 && Clock::now() >= warn_at_) {
            warn_at_ = Clock::time_point::max();
            std::clog << "handtouch: no daemon at " << endpoint_ << "; start `handtouch run FILE`" << std::endl;
        }
        if (!unknown_.empty()) throw UnknownNameError(unknown_);
        while (receive(event_, monitor_.get(), ZMQ_DONTWAIT)) {
            void_order_ = received_;
            while (more(monitor_.get())) receive(event_, monitor_.get(), 0);
        }
        return alive() ? state_.frame() : nullptr;
    }

    // As `latest`, as soon as it is newer than the one returned before; nullptr after the timeout.
    const Frame* wait(std::chrono::milliseconds timeout) {
        const auto longest = std::chrono::hours(24 * 365);  // now plus a longer one may overflow
        const auto end = Clock::now() + (timeout < longest ? timeout : std::chrono::milliseconds(longest));
        const Frame* frame = latest();
        while (frame == nullptr || (frame->session == seen_session_ && frame->seq == seen_seq_)) {
            const auto until = received_ == 0 ? std::min<Clock::time_point>(end, warn_at_) : end;
            const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now());
            zmq_pollitem_t items[] = {{socket_.get(), 0, ZMQ_POLLIN, 0}, {monitor_.get(), 0, ZMQ_POLLIN, 0}};
            if (left.count() < 0 || zmq_poll(items, 2, static_cast<long>(left.count())) == 0)
                if (until == end) return nullptr;
            frame = latest();
        }
        seen_session_ = frame->session;
        seen_seq_ = frame->seq;
        return frame;
    }

    // Active contacts by link, as of the last call of `latest` or `wait`; none without a daemon.
    std::map<std::string, Contact> contacts() const {
        return alive() ? state_.contacts() : std::map<std::string, Contact>();
    }

    // True while the newest frame is young enough, and the connection wasn't lost since.
    bool alive() const {
        const Frame* frame = state_.frame();
        if (frame == nullptr || state_.frame_order() < void_order_) return false;
        const std::int64_t limit_ns = max_age_ns_ > 0 ? max_age_ns_ : std::max(min_age_ns, 3 * state_.period_ns());
        const std::optional<std::int64_t> now = daemon_ns();
        return now && *now - frame->t_ns <= limit_ns;
    }

    // Age of the newest frame; infinite without one. On another machine a lower bound, by the smallest delay seen.
    double age_s() const {
        const std::optional<std::int64_t> now = daemon_ns();
        return now && state_.frame() ? 1e-9 * static_cast<double>(*now - state_.frame()->t_ns) : HUGE_VAL;
    }

    // Messages dropped because they violate the wire contract.
    std::int64_t malformed_messages() const { return malformed_; }

    // Now on the clock of t_ns, where the daemon runs on this machine.
    static std::int64_t now_ns() {
        return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now().time_since_epoch()).count();
    }

private:
    static constexpr const char* monitor_endpoint = "inproc://monitor";  // of this hand's own context
    static constexpr std::int64_t min_age_ns = 50000000, max_drift_ppm = 500;

    static bool is_local(const std::string& endpoint) {
        for (const char* start : {"ipc://", "inproc://", "tcp://127.", "tcp://localhost", "tcp://[::1]"})
            if (endpoint.rfind(start, 0) == 0) return true;
        return false;
    }

    // Now on the daemon's clock; on another machine the least that it may be, by the smallest delay seen, which
    // widens by the drift of clocks. Absent before a message.
    std::optional<std::int64_t> daemon_ns() const {
        const std::int64_t here = now_ns();
        if (state_.is_replay() && state_.frame()) return here - frame_ns_ + state_.frame()->t_ns;
        if (is_local_) return here;
        if (!offset_ns_) return std::nullopt;
        return here - widened(here);
    }
    std::int64_t widened(std::int64_t here) const { return *offset_ns_ + (here - offset_at_ns_) * max_drift_ppm / 1000000 + 1; }
    void observe(std::int64_t session, std::int64_t t_ns, bool retained) {
        if (session != clock_session_) offset_ns_.reset();
        clock_session_ = session;
        if (retained) return;
        if (receive_ns_ < t_ns) is_local_ = false;  // a tunnel to another machine
        const std::int64_t found = receive_ns_ - t_ns;
        offset_ns_ = offset_ns_ ? std::min(widened(receive_ns_), found) : found;
        offset_at_ns_ = receive_ns_;
    }

    struct CloseContext {
        void operator()(void* context) const { zmq_ctx_term(context); }
    };
    struct CloseSocket {
        void operator()(void* socket) const { zmq_close(socket); }
    };

    static void check(int result, const std::string& what) {
        if (result != 0) throw std::runtime_error(what + ": " + zmq_strerror(zmq_errno()));
    }
    void set(int option, int value) {
        check(zmq_setsockopt(socket_.get(), option, &value, sizeof value), "ZeroMQ option");
    }
    void set(int option, const std::string& value) {
        check(zmq_setsockopt(socket_.get(), option, value.data(), value.size()), "ZeroMQ option");
    }

    // Receive all waiting messages; decode every contact, and the newest frame.
    void drain() {
        std::string payload, newest;
        std::int64_t newest_order = -1;
        while (receive(part_, socket_.get(), ZMQ_DONTWAIT)) {
            const std::string topic = part_;
            int parts = 1;
            for (; more(socket_.get()); ++parts) receive(payload, socket_.get(), 0);
            const std::int64_t order = received_++;
            const bool is_contact = topic.compare(0, contact_prefix_.size(), contact_prefix_) == 0;
            const bool is_service = topic == "service";
            if (!is_contact && !is_service && topic != frame_topic_) continue;
            if (parts != 2) {
                ++malformed_;
            } else if (is_contact) {
                decode([&] { feed_contact(decode_contact(payload), order); });
            } else if (is_service) {
                decode([&] { feed_service(decode_service(payload), order); });
            } else {
                newest.swap(payload);
                newest_order = order;
            }
        }
        if (newest_order >= 0) decode([&] { feed_frame(decode_frame(newest), newest_order); });
    }

    void feed_service(const Service& service, std::int64_t order) {
        receive_ns_ = now_ns();
        state_.feed(service, order);
        const bool has_hand = std::count(service.hands.begin(), service.hands.end(), name_) > 0;
        unknown_ = has_hand ? "" : "the daemon has no hand '" + name_ + "'; it has";
        for (const std::string& hand : service.hands)
            if (!has_hand) unknown_ += (hand == service.hands.front() ? " " : ", ") + hand;
        if (service.session == state_.session()) observe(service.session, service.t_ns, service.retained);
    }

    void feed_frame(Frame frame, std::int64_t order) {
        receive_ns_ = now_ns();
        const std::int64_t session = frame.session, t_ns = frame.t_ns, before = state_.frame_order();
        const bool retained = frame.retained;
        state_.feed(std::move(frame), order);
        if (state_.frame_order() != before) frame_ns_ = receive_ns_;
        if (session == state_.session()) observe(session, t_ns, retained);
    }

    void feed_contact(Contact contact, std::int64_t order) {
        if (on_contact) on_contact(contact);
        state_.feed(std::move(contact), order);
    }

    template <class Work>
    void decode(Work work) {
        try {
            work();
        } catch (const WireError&) {
            ++malformed_;
        }
    }

    static bool receive(std::string& into, void* socket, int flags) {
        zmq_msg_t message;
        zmq_msg_init(&message);
        const bool received = zmq_msg_recv(&message, socket, flags) >= 0;
        if (received) into.assign(static_cast<const char*>(zmq_msg_data(&message)), zmq_msg_size(&message));
        zmq_msg_close(&message);
        return received;
    }

    static bool more(void* socket) {
        int value = 0;
        std::size_t size = sizeof value;
        return zmq_getsockopt(socket, ZMQ_RCVMORE, &value, &size) == 0 && value != 0;
    }

    std::int64_t max_age_ns_;
    bool is_local_;
    std::string name_, endpoint_, unknown_, frame_topic_, contact_prefix_, part_, event_;
    Clock::time_point warn_at_ = Clock::now() + std::chrono::seconds(2);  // if nothing was received
    std::unique_ptr<void, CloseContext> context_;
    std::unique_ptr<void, CloseSocket> socket_, monitor_;  // closed before their context
    HandState state_;
    std::int64_t receive_ns_ = 0, frame_ns_ = 0, offset_at_ns_ = 0, clock_session_ = -1;
    std::optional<std::int64_t> offset_ns_;  // of this clock from the daemon's, at most
    std::int64_t void_order_ = 0;  // frames before it are of a lost connection
    std::int64_t received_ = 0, malformed_ = 0, seen_session_ = -1, seen_seq_ = -1;
};

}  // namespace handtouch
