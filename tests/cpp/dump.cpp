// Print what the C++ client reads, as lines of JSON; as tests/javascript/dump.mjs does.
//
//     dump all ENDPOINT COUNT     every contact and hand message, until so many have come
//     dump newest ENDPOINT COUNT  newest frames of the hand `right`, and the contacts with each
//     dump ages ENDPOINT COUNT    after a line of input, the ages of so many newest frames, or "none"
//     dump unknown ENDPOINT       the error of a hand that the daemon doesn't have
//     dump touched                for each line of hexadecimal digits whether the first pad is touched
//     dump decode                 for each line of hexadecimal digits "ok" or "refused"
#include <handtouch/hand.hpp>

#include <cinttypes>
#include <cstdio>
#include <iostream>

namespace {

void print(const std::string& value) { std::printf("\"%s\"", value.c_str()); }
void print(bool value) { std::fputs(value ? "true" : "false", stdout); }
void print(std::int64_t value) { std::printf("%" PRId64, value); }
void print(std::uint32_t value) { std::printf("%" PRIu32, value); }
void print(std::uint8_t value) { std::printf("%u", value); }
void print(double value) { std::isnan(value) ? std::printf("null") : std::printf("%.17g", value); }
void print(float value) { print(static_cast<double>(value)); }

template <class Items>
void print_list(const Items& items) {
    const char* separator = "";
    std::putchar('[');
    for (const auto& item : items) {
        std::fputs(separator, stdout);
        print(item);
        separator = ",";
    }
    std::putchar(']');
}

template <std::size_t N>
void print(const handtouch::Vector<N>& value) { print_list(value); }
void print(const std::vector<std::string>& value) { print_list(value); }
template <class T, std::size_t N>
void print(const handtouch::Column<T, N>& value) { print_list(value.values()); }

template <class T>
void print(const std::optional<T>& value) {
    if (value) print(*value);
    else std::fputs("null", stdout);
}

template <class T>
void field(const std::string& name, const T& value) {
    std::printf(",\"%s\":", name.c_str());
    print(value);
}

template <class T, std::size_t N>
void optional_field(const char* name, const handtouch::Column<T, N>& column) {
    if (!column.empty()) field(name, column);
}

void print_place(const std::string& prefix, const std::string& status, const handtouch::Place& place) {
    field(prefix + "position_m", place.position_m);
    field(prefix + "normal", place.normal);
    field(prefix + "covariance_m2", place.covariance_m2);
    field(status, place.status);
}

void print_vectors(const std::string& prefix, const handtouch::Place& place) {
    if (!place.position_m) return;
    field(prefix + "position_m", place.position_m);
    field(prefix + "normal", place.normal);
    field(prefix + "covariance_m2", place.covariance_m2);
}

void print_parts(const std::vector<handtouch::ContactPart>& parts) {
    std::fputs(",\"parts\":[", stdout);
    const char* separator = "";
    for (const handtouch::ContactPart& part : parts) {
        std::printf("%s{\"force_n\":", separator);
        print(part.force_n);
        field("force_std_n", part.force_std_n);
        print_vectors("", part.in_link);
        print_vectors("palm_", part.in_palm);
        print_vectors("base_", part.in_base);
        field("id", part.id);
        std::putchar('}');
        separator = ",";
    }
    std::putchar(']');
}

void print_contact(const handtouch::Contact& c) {
    std::printf("{\"kind\":\"contact\"");
    field("session", c.session); field("seq", c.seq); field("t_ns", c.t_ns); field("begin_ns", c.begin_ns);
    field("id", c.id); field("group", c.group); field("event", c.event); field("hand", c.hand);
    field("link", c.link); field("end_reason", c.end_reason); field("calibration_id", c.calibration_id);
    field("force_status", c.force_status); field("retained", c.retained); field("duration_s", c.duration_s);
    field("fresh", c.fresh);
    field("age_s", c.age_s); field("begin_threshold_n", c.begin_threshold_n);
    field("end_threshold_n", c.end_threshold_n); field("pad_m", c.pad_m); field("force_n", c.force_n);
    field("force_std_n", c.force_std_n); field("peak_force_n", c.peak_force_n);
    field("total_current_a", c.total_current_a); field("uncompensated_force_n", c.uncompensated_force_n);
    field("residual", c.residual); field("residual_std", c.residual_std);
    field("joints_age_s", c.joints_age_s); field("diagnoses", c.diagnoses);
    print_place("", "position_status", c.in_link);
    field("mount_covariance_m2", c.mount_covariance_m2);
    print_place("palm_", "palm_status", c.in_palm);
    print_place("base_", "base_status", c.in_base);
    field("force_vector_status", c.force_vector_status); field("force_vector_n", c.force_vector_n);
    field("force_vector_covariance_n2", c.force_vector_covariance_n2);
    field("palm_force_vector_n", c.palm_force_vector_n); field("base_force_vector_n", c.base_force_vector_n);
    print_parts(c.parts);
    std::puts("}");
}

void print_frame(const handtouch::Frame& f, const std::map<std::string, handtouch::Contact>* contacts) {
    std::printf("{\"kind\":\"hand\"");
    field("session", f.session); field("seq", f.seq); field("t_ns", f.t_ns); field("tick", f.tick);
    field("retained", f.retained); field("hand", f.hand); field("links", f.links); field("state", f.state);
    field("contact_id", f.contact_id); field("sample_ns", f.sample_ns);
    field("total_current_a", f.total_current_a); field("position_m", f.position_m); field("normal", f.normal);
    field("covariance_m2", f.covariance_m2); field("pad_m", f.pad_m);
    field("position_status", f.position_status); field("force_n", f.force_n);
    field("force_std_n", f.force_std_n); field("force_status", f.force_status);
    field("residual", f.residual); field("residual_std", f.residual_std);
    optional_field("group", f.group);
    optional_field("palm_status", f.palm_status); optional_field("palm_position_m", f.palm_position_m);
    optional_field("palm_normal", f.palm_normal); optional_field("palm_covariance_m2", f.palm_covariance_m2);
    optional_field("base_status", f.base_status); optional_field("base_position_m", f.base_position_m);
    optional_field("base_normal", f.base_normal); optional_field("base_covariance_m2", f.base_covariance_m2);
    optional_field("mount_covariance_m2", f.mount_covariance_m2);
    optional_field("joints_age_s", f.joints_age_s);
    optional_field("force_vector_status", f.force_vector_status);
    optional_field("force_vector_n", f.force_vector_n);
    optional_field("force_vector_covariance_n2", f.force_vector_covariance_n2);
    optional_field("palm_force_vector_n", f.palm_force_vector_n);
    optional_field("base_force_vector_n", f.base_force_vector_n);
    if (contacts != nullptr) {
        std::printf(",\"contacts\":{");
        const char* separator = "";
        for (const auto& [link, contact] : *contacts) {
            std::printf("%s\"%s\":%" PRId64, separator, link.c_str(), contact.id);
            separator = ",";
        }
        std::putchar('}');
    }
    std::puts("}");
}

std::string receive(void* socket) {
    zmq_msg_t message;
    zmq_msg_init(&message);
    if (zmq_msg_recv(&message, socket, 0) < 0) throw std::runtime_error(zmq_strerror(zmq_errno()));
    std::string bytes(static_cast<const char*>(zmq_msg_data(&message)), zmq_msg_size(&message));
    zmq_msg_close(&message);
    return bytes;
}

void dump_all(const char* endpoint, int count) {
    void* context = zmq_ctx_new();
    void* socket = zmq_socket(context, ZMQ_SUB);
    const int queue = 100000;
    zmq_setsockopt(socket, ZMQ_RCVHWM, &queue, sizeof queue);
    zmq_setsockopt(socket, ZMQ_SUBSCRIBE, "", 0);
    zmq_connect(socket, endpoint);
    for (int i = 0; i < count; ++i) {
        const std::string topic = receive(socket), payload = receive(socket);
        if (topic.compare(0, 8, "contact/") == 0) print_contact(handtouch::decode_contact(payload));
        else print_frame(handtouch::decode_frame(payload), nullptr);
    }
    zmq_close(socket);
    zmq_ctx_term(context);
}

void dump_newest(const char* endpoint, int count) {
    handtouch::Hand hand("right", endpoint, nullptr, std::chrono::hours(1000000));  // whatever its age
    hand.on_contact = print_contact;
    for (int i = 0; i < count; ++i) {
        const handtouch::Frame* frame = hand.wait(std::chrono::seconds(60));
        if (frame == nullptr) throw std::runtime_error("no frame");
        const auto contacts = hand.contacts();
        print_frame(*frame, &contacts);
        std::fflush(stdout);
    }
}

void dump_ages(const char* endpoint, int count) {
    handtouch::Hand hand("right", endpoint);
    while (hand.wait(std::chrono::milliseconds(10)) == nullptr) continue;
    std::puts("{\"kind\":\"ready\"}");
    std::fflush(stdout);
    std::string line;
    std::getline(std::cin, line);
    for (int i = 0; i < count; ++i) {
        const handtouch::Frame* frame = hand.latest();
        if (frame == nullptr) {
            std::puts("{\"kind\":\"none\"}");
        } else {
            std::printf("{\"kind\":\"hand\"");
            field("age_s", 1e-9 * static_cast<double>(handtouch::Hand::now_ns() - frame->t_ns));
            std::puts("}");
        }
        std::fflush(stdout);
        zmq_poll(nullptr, 0, 5);
    }
}

void dump_unknown(const char* endpoint) {
    handtouch::Hand hand("rigth", endpoint);
    try {
        hand.wait(std::chrono::seconds(60));
    } catch (const handtouch::UnknownNameError& error) {
        std::puts(error.what());
    }
}

void dump_touched() {
    for (std::string line; std::getline(std::cin, line);) {
        std::string bytes;
        for (std::size_t i = 0; i + 1 < line.size(); i += 2)
            bytes.push_back(static_cast<char>(std::stoi(line.substr(i, 2), nullptr, 16)));
        try {
            std::puts(handtouch::decode_frame(bytes).touched(0) ? "touched" : "clear");
        } catch (const handtouch::NotSampledError& error) {
            std::puts(error.what());
        }
    }
}

void dump_decoded() {
    for (std::string line; std::getline(std::cin, line);) {
        std::string bytes;
        for (std::size_t i = 0; i + 1 < line.size(); i += 2)
            bytes.push_back(static_cast<char>(std::stoi(line.substr(i, 2), nullptr, 16)));
        try {
            handtouch::decode_frame(bytes);
            std::puts("ok");
        } catch (const handtouch::WireError&) {
            std::puts("refused");
        }
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::string mode = argc > 1 ? argv[1] : "";
    if (mode == "all" && argc == 4) dump_all(argv[2], std::atoi(argv[3]));
    else if (mode == "newest" && argc == 4) dump_newest(argv[2], std::atoi(argv[3]));
    else if (mode == "ages" && argc == 4) dump_ages(argv[2], std::atoi(argv[3]));
    else if (mode == "unknown" && argc == 3) dump_unknown(argv[2]);
    else if (mode == "touched") dump_touched();
    else if (mode == "decode") dump_decoded();
    else return 2;
}
